"""The daemon's metrics as one table: name, meaning, labels, and where in a `Reading` the number stands.

Names follow Prometheus' conventions: base units, ``_total`` for counters, ``_seconds``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from companion.state import Situation, State

Sample = tuple[tuple[str, ...], float]  # the values of the labels, and the number
Counts = Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What the daemon says of itself at one instant. Mappings are read, never kept."""

    version: str
    config_hash: str
    vehicle: str
    profile: str
    situation: Situation
    armed: bool
    beat_age_s: float | None  # of the control task's last turn
    verdicts: Counts
    bucket_counts: tuple[int, ...]  # of `TickMeter`
    latency_sum_s: float
    deadline_misses: int
    states_skipped: int
    tracks: int
    agile: int
    warnings: int
    accepted: Counts  # frames by source
    source_age_s: Mapping[str, float]
    groups: Mapping[str, Counts]  # every other counter: by part of the daemon, then by what is counted
    links: tuple[Counts, ...]  # bytes and losses of each MAVLink link, the autopilot's first
    log_failed: bool


@dataclass(frozen=True, slots=True)
class Definition:
    """One metric: its name without ``_total``, what it means, and where it is read."""

    name: str
    kind: Literal["counter", "gauge"]
    meaning: str
    read: Callable[[Reading], Iterable[Sample]]
    labels: tuple[str, ...] = ()

    @property
    def exposed(self) -> str:
        """Its name on the wire."""
        return f"{self.name}_total" if self.kind == "counter" else self.name


def _one(value: Callable[[Reading], float]) -> Callable[[Reading], Iterable[Sample]]:
    return lambda reading: [((), float(value(reading)))]


def _by(counts: Callable[[Reading], Mapping[str, float]]) -> Callable[[Reading], Iterable[Sample]]:
    return lambda reading: [((name,), float(count)) for name, count in sorted(counts(reading).items())]


def _group(name: str, *left_out: str) -> Callable[[Reading], Iterable[Sample]]:
    return _by(lambda reading: {k: n for k, n in reading.groups.get(name, {}).items() if k not in left_out})


def _count(group: str, name: str) -> Callable[[Reading], Iterable[Sample]]:
    return _one(lambda reading: reading.groups.get(group, {}).get(name, 0))


def _links(name: str) -> Callable[[Reading], Iterable[Sample]]:
    return lambda reading: [((str(i),), float(counts.get(name, 0))) for i, counts in enumerate(reading.links)]


_FRAMING = ("messages", "unknown", "bad_packets", "garbage_bytes", "allowed_unsigned")

METRICS = (
    Definition(
        "companion_build_info",
        "gauge",
        "Always 1; the labels tell what flies.",
        lambda r: [((r.version, r.config_hash, r.vehicle, r.profile), 1.0)],
        ("version", "config_hash", "vehicle", "profile"),
    ),
    Definition(
        "companion_state",
        "gauge",
        "1 for the state that the daemon is in, 0 for the others.",
        lambda r: [((state.value,), float(state is r.situation.state)) for state in State],
        ("state",),
    ),
    Definition("companion_engaged", "gauge", "1 while the engaged latch is set.", _one(lambda r: r.situation.engaged)),
    Definition(
        "companion_external_mode",
        "gauge",
        "1 while the autopilot is in the mode in which it obeys setpoints.",
        _one(lambda r: r.situation.external),
    ),
    Definition("companion_armed", "gauge", "1 while the vehicle is armed.", _one(lambda r: r.armed)),
    Definition(
        "companion_airborne", "gauge", "1 while the vehicle is in the air.", _one(lambda r: r.situation.airborne)
    ),
    Definition(
        "companion_vehicle_fresh",
        "gauge",
        "1 while heartbeat and vehicle state are fresh.",
        _one(lambda r: r.situation.fresh),
    ),
    Definition(
        "companion_degraded",
        "gauge",
        "1 while the inputs of the brain allow only holding.",
        _one(lambda r: r.situation.degraded),
    ),
    Definition(
        "companion_warnings",
        "gauge",
        "Warnings that stand now, such as setpoints not followed.",
        _one(lambda r: r.warnings),
    ),
    Definition(
        "companion_control_age_seconds",
        "gauge",
        "Since the control task's last turn; it turns at least every 0.2 s. Absent before the first.",
        lambda r: [] if r.beat_age_s is None else [((), r.beat_age_s)],
    ),
    Definition(
        "companion_ticks",
        "counter",
        "Ticks answered, by the verdict of the safety filter.",
        _by(lambda r: r.verdicts),
        ("verdict",),
    ),
    Definition(
        "companion_deadline_misses",
        "counter",
        "Ticks whose work outlasted the control period, and vehicle states skipped.",
        _one(lambda r: r.deadline_misses),
    ),
    Definition(
        "companion_vehicle_states_skipped",
        "counter",
        "Vehicle states overtaken by a newer one before they were answered, or stale on arrival.",
        _one(lambda r: r.states_skipped),
    ),
    Definition("companion_tracks", "gauge", "Obstacles tracked now.", _one(lambda r: r.tracks)),
    Definition(
        "companion_agile_tracks",
        "gauge",
        "Tracks that break their assumed agility: their predictions are widened.",
        _one(lambda r: r.agile),
    ),
    Definition(
        "companion_track_events",
        "counter",
        "What happened to tracks and detections in the tracker.",
        _group("tracking"),
        ("event",),
    ),
    Definition(
        "companion_obstacle_frames",
        "counter",
        "Obstacle frames accepted, by source.",
        _by(lambda r: r.accepted),
        ("source",),
    ),
    Definition(
        "companion_obstacle_frames_rejected",
        "counter",
        "Obstacle frames and other Zenoh payloads refused, by reason.",
        _group("obstacles", "frames", "dropped", "thinned"),
        ("reason",),
    ),
    Definition(
        "companion_obstacle_frames_dropped",
        "counter",
        "Obstacle frames lost because the queue of their source was full.",
        _count("obstacles", "dropped"),
    ),
    Definition(
        "companion_obstacle_frames_thinned",
        "counter",
        "Obstacle frames left out because their source is much faster than the ticks.",
        _count("obstacles", "thinned"),
    ),
    Definition(
        "companion_obstacle_source_age_seconds",
        "gauge",
        "Vehicle time since the stamp of a source's newest accepted frame.",
        _by(lambda r: r.source_age_s),
        ("source",),
    ),
    Definition(
        "companion_mavlink_messages_received",
        "counter",
        "Intact MAVLink messages, on all links.",
        _count("mavlink", "messages"),
    ),
    Definition(
        "companion_mavlink_messages_unknown",
        "counter",
        "MAVLink messages outside the dialect.",
        _count("mavlink", "unknown"),
    ),
    Definition(
        "companion_mavlink_packets_damaged",
        "counter",
        "MAVLink packets whose header or checksum is wrong.",
        _count("mavlink", "bad_packets"),
    ),
    Definition(
        "companion_mavlink_garbage_bytes",
        "counter",
        "Bytes between MAVLink packets.",
        _count("mavlink", "garbage_bytes"),
    ),
    Definition(
        "companion_mavlink_messages_rejected",
        "counter",
        "Intact MAVLink messages refused, by reason: their signature, or numbers that cannot be.",
        _group("mavlink", *_FRAMING),
        ("reason",),
    ),
    Definition(
        "companion_mavlink_link_received_bytes", "counter", "Bytes read, by link.", _links("bytes_in"), ("link",)
    ),
    Definition(
        "companion_mavlink_link_sent_bytes", "counter", "Bytes written, by link.", _links("bytes_out"), ("link",)
    ),
    Definition(
        "companion_mavlink_link_dropped",
        "counter",
        "Writes that a link could not take and lost.",
        _links("dropped"),
        ("link",),
    ),
    Definition(
        "companion_mavlink_link_errors", "counter", "Errors of the system on a link.", _links("errors"), ("link",)
    ),
    Definition(
        "companion_mavlink_routed",
        "counter",
        "What the router saw: packets passed on, loops, setpoints of others.",
        _group("router"),
        ("event",),
    ),
    Definition(
        "companion_autopilot_events",
        "counter",
        "What was noticed about the autopilot: setpoints confirmed or not followed, streams lost, clocks set.",
        _group("autopilot"),
        ("event",),
    ),
    Definition(
        "companion_timesync_replies",
        "counter",
        "TIMESYNC replies and what came of them.",
        _group("timesync"),
        ("result",),
    ),
    Definition(
        "companion_statustexts_suppressed",
        "counter",
        "STATUSTEXTs not sent, because repeated or too many.",
        _group("texts"),
        ("reason",),
    ),
    Definition(
        "companion_zenoh_messages_received",
        "counter",
        "Messages by Zenoh, from subscriptions and queries.",
        _count("zenoh", "received"),
    ),
    Definition(
        "companion_zenoh_messages_dropped",
        "counter",
        "Messages by Zenoh lost because the daemon did not keep up.",
        _count("zenoh", "dropped"),
    ),
    Definition(
        "companion_zenoh_messages_oversized",
        "counter",
        "Messages by Zenoh refused unread because of their size.",
        _count("zenoh", "too_large"),
    ),
    Definition(
        "companion_log_messages_lost",
        "counter",
        "Messages that did not get into the flight log: dropped (its queue was full), lost (after it failed), broken.",
        _group("log"),
        ("reason",),
    ),
    Definition(
        "companion_log_failed", "gauge", "1 once the log could not be written any more.", _one(lambda r: r.log_failed)
    ),
)
