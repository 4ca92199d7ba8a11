"""What an operator needs to know of one vehicle, from the newest payload of each of its keys. Pure.

With r = p_o - p the clearance is |r| - r_o - r_drone, surface to surface as estimated; it closes at
-r . (v_o - v) / |r|.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from msgspec import Struct

from companion.config import SafetyConfig
from companion.link import mav, wire
from companion.profiles import PROFILES

Presence = Literal["alive", "silent", "gone"]

SILENT_S = 1.0  # without a status, which comes at 5 Hz


@dataclass(frozen=True, slots=True)
class Sight:
    """The newest of a vehicle, as far as it was heard; ages are of its arrival here."""

    name: str
    status: wire.Status | None = None
    status_age_s: float | None = None
    record: wire.SetpointRecord | None = None
    vehicle: wire.VehicleOut | None = None
    tracks: wire.TracksOut | None = None
    rate_hz: float | None = None  # of the ticks
    token: bool | None = None  # its liveliness token; None: never seen
    drone_radius_m: float | None = None  # as its configuration says
    malformed: int = 0  # payloads that could not be read


class Nearest(Struct, frozen=True, kw_only=True):
    """The track with the least clearance."""

    id: str
    clearance_m: float
    closing_m_s: float  # > 0: coming nearer
    status: str


class Essentials(Struct, frozen=True, kw_only=True):
    """One vehicle; what was not heard is None. ``companion monitor --json`` prints these."""

    name: str
    presence: Presence
    silent_s: float | None  # since the last status
    state: str | None
    reason: str | None
    mode: str | None  # of the autopilot
    profile: str | None
    engaged: bool | None
    armed: bool | None
    airborne: bool | None
    verdict: str | None
    sent: bool | None
    position: wire.Vec | None
    speed_m_s: float | None
    target: wire.Vec | None
    target_m: float | None
    tracks: int
    nearest: Nearest | None
    worst: str | None  # the row of least slack: its track, or the name of a limit
    epsilon: float | None  # of that row
    slack_m_s2: float | None
    latency_ms: float | None  # of the newest tick
    tick_ms: dict[str, float]
    rate_hz: float | None
    deadline_misses: int | None
    warnings: list[str]
    sources: dict[str, wire.SourceOut]
    rejected: dict[str, int]  # obstacle frames by reason
    malformed: int


def essentials(sight: Sight) -> Essentials:
    """The vehicle in short."""
    status, record, vehicle = sight.status, sight.record, sight.vehicle
    worst = None if record is None else record.worst
    target = None if status is None else status.target
    p = None if vehicle is None else vehicle.position
    return Essentials(
        name=sight.name,
        presence=presence(sight),
        silent_s=_rounded(sight.status_age_s),
        state=None if status is None else status.state,
        reason=None if status is None else status.reason,
        mode=None if status is None else mode_name(status.profile, status.vehicle_mode),
        profile=None if status is None else status.profile,
        engaged=None if status is None else status.engaged,
        armed=None if status is None else status.armed,
        airborne=None if status is None else status.airborne,
        verdict=None if record is None else record.verdict,
        sent=None if record is None else record.sent,
        position=p,
        speed_m_s=None if vehicle is None else _rounded(math.hypot(*vehicle.velocity)),
        target=target,
        target_m=None if p is None or target is None else _rounded(math.dist(p, target)),
        tracks=0 if sight.tracks is None else len(sight.tracks.tracks),
        nearest=nearest(sight),
        worst=None if worst is None else worst.track,
        epsilon=None if worst is None else _rounded(worst.epsilon),
        slack_m_s2=None if worst is None else _rounded(worst.slack),
        latency_ms=None if record is None else _rounded(record.timings_ms.get("total")),
        tick_ms={} if status is None else status.tick_ms,
        rate_hz=_rounded(sight.rate_hz),
        deadline_misses=None if status is None else status.counts.get("deadline_misses"),
        warnings=[] if status is None else status.warnings,
        sources={} if status is None else status.sources,
        rejected={} if status is None else rejected(status.counts),
        malformed=sight.malformed,
    )


def presence(sight: Sight) -> Presence:
    """``gone``: its token was dropped; ``silent``: no status for `SILENT_S`, or none yet; else ``alive``."""
    if sight.token is False:
        return "gone"
    if sight.status_age_s is None or sight.status_age_s > SILENT_S:
        return "silent"
    return "alive"


def nearest(sight: Sight) -> Nearest | None:
    """The track of least clearance from where the vehicle is."""
    if sight.vehicle is None or sight.tracks is None or not sight.tracks.tracks:
        return None
    p, v = sight.vehicle.position, sight.vehicle.velocity
    own_m = SafetyConfig().drone_radius_m if sight.drone_radius_m is None else sight.drone_radius_m
    track = min(sight.tracks.tracks, key=lambda track: math.dist(track.position, p) - track.radius)
    r = [a - b for a, b in zip(track.position, p, strict=True)]
    distance_m = math.hypot(*r)
    closing = -sum(x * (a - b) for x, a, b in zip(r, track.velocity, v, strict=True)) / max(distance_m, 1e-9)
    return Nearest(
        id=track.id,
        clearance_m=round(distance_m - track.radius - own_m, 3),
        closing_m_s=round(closing, 3),
        status=track.status,
    )


def rejected(counts: dict[str, int]) -> dict[str, int]:
    """Obstacle frames that were not used, by reason."""
    named = {name.removeprefix("obstacles."): n for name, n in counts.items() if name.startswith("obstacles.")}
    return {name: n for name, n in named.items() if n and name != "frames"}


def mode_name(profile: str, custom_mode: str) -> str:
    """The autopilot's mode in words, where profile and number are known.

    >>> mode_name("ardupilot", "4"), mode_name("px4", "393216"), mode_name("px4", "unknown")
    ('GUIDED', 'OFFBOARD', 'unknown')
    """
    known = PROFILES.get(profile)
    if known is None or not (custom_mode.isascii() and custom_mode.isdigit()):
        return custom_mode
    return mav.mode_name(known.autopilot, int(custom_mode))


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
