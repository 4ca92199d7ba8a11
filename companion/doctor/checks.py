"""Pure checks: an `Observation` and the configuration in, lines out."""

from __future__ import annotations

from collections.abc import Iterator

from companion.config import Config
from companion.doctor.failsafe import failsafe_checks
from companion.doctor.observation import ARDUPILOT, PX4, Autopilot, Link, Machine, Observation, Source, Stream, Zenoh
from companion.doctor.verdict import Check, Level, grade, skip
from companion.link.ingress import FUTURE_NS
from companion.types import NS_PER_S

KINDS = {PX4: "PX4", ARDUPILOT: "ArduPilot"}
_PROFILES = {PX4: ("px4", "crazyflie-sim", "auto"), ARDUPILOT: ("ardupilot", "auto")}
RATE_SHARE, LEAST_SHARE = 0.9, 0.5  # of the wanted rate: below the first a warning, below the second a failure
SLOW_ROUND_TRIP_MS = 20.0
AHEAD_S = 0.005  # a sensor host's clock may be ahead of ours by this much
MAX_AHEAD_S = FUTURE_NS / NS_PER_S
ALL_REJECTED_SHARE = 0.5
BUSY_SHARE = 0.5  # of the tick period, for the 99th percentile of a brain step
_RESULTS = {0: "accepted", 1: "temporarily rejected", 2: "denied", 3: "unsupported", 4: "failed"}


def run_checks(seen: Observation, config: Config) -> list[Check]:
    """Every check, in the order in which they are printed."""
    checks = [*link_checks(seen.link, config)]
    if seen.link.autopilot is not None:
        checks += vehicle_checks(seen.link.autopilot, config, seen.measured_s)
    checks += zenoh_checks(seen.zenoh, seen.link, config)
    checks += machine_checks(seen.machine)
    return checks


def link_checks(link: Link, config: Config) -> Iterator[Check]:
    """Whether the autopilot is there, and the kind that the profile is for."""
    if link.error is not None:
        yield Check(Level.FAIL, "link", link.error, "a link that opens; is the daemon running on it?")
        return
    autopilot = link.autopilot
    if autopilot is None:
        if link.systems:
            wanted = config.mavlink.system_id
            expected = "one autopilot, or mavlink.system_id" if wanted is None else f"system {wanted}"
            heard = ", ".join(str(system) for system in link.systems)
            yield Check(Level.FAIL, "autopilot", f"heard: system {heard}", expected)
        else:
            found = "bytes, but no heartbeat of an autopilot" if link.bytes_in else "nothing"
            yield Check(Level.FAIL, "autopilot", f"{found} on {link.url}", "heartbeats of an autopilot")
        return
    kind = KINDS.get(autopilot.kind, f"kind {autopilot.kind}")
    profiles = _PROFILES.get(autopilot.kind, ())
    profile = config.vehicle.profile
    found = f"{kind}, system {autopilot.system} component {autopilot.component}, profile {profile}"
    yield grade("autopilot", found, f"one that the profile is for: {kind} has {', '.join(profiles) or 'none'}",
                fail=profile not in profiles)  # fmt: skip


def vehicle_checks(autopilot: Autopilot, config: Config, measured_s: float) -> list[Check]:
    """Streams over a window of ``measured_s``, time, parameters, fixes."""
    lockstep = config.sync == "lockstep"
    checks = [
        skip(name, "lockstep: the simulator waits for the daemon")
        if lockstep and name != "HEARTBEAT"
        else _stream(name, stream, config, measured_s)
        for name, stream in autopilot.streams.items()
    ]
    checks.append(skip("TIMESYNC", "lockstep") if lockstep else _timesync(autopilot))
    checks.append(_date(autopilot))
    checks += failsafe_checks(autopilot, config)
    for fix in autopilot.fixes:
        before = "unknown" if fix.before is None else f"{fix.before:g}"
        after = "no answer" if fix.after is None else f"{fix.after:g}"
        found = f"refused: {fix.refused}" if fix.refused else f"was {before}, reads {after} now"
        checks.append(grade(f"fix {fix.name}", found, f"{fix.wanted:g}", fail=not fix.done))
    return checks


def _stream(name: str, stream: Stream, config: Config, measured_s: float) -> Check:
    heard = f"{stream.heard_hz:.1f} Hz"
    if stream.longest_gap_s is not None:
        heard += f", longest gap {1e3 * stream.longest_gap_s:.0f} ms"
    if stream.ack is not None and stream.ack != 0:
        heard += f"; asking for it was {_RESULTS.get(stream.ack, f'answered with {stream.ack}')}"
    if name == "LOCAL_POSITION_NED" and stream.heard_hz == 0.0:
        heard += " (an estimator without a position sends none: it may need a minute, or a fix)"
    timeout_s = config.mavlink.heartbeat_timeout_s if name == "HEARTBEAT" else config.vehicle.stale_s
    late = name != "EXTENDED_SYS_STATE" and (stream.longest_gap_s or 0.0) > timeout_s
    measured_s = stream.measured_s or measured_s
    counted = 0.0 if stream.heard_hz == 0.0 else 1.0  # a window may begin just behind a message and end just before one
    share = (stream.heard_hz * measured_s + counted) / (stream.wanted_hz * measured_s)
    return grade(
        name,
        heard,
        f"{stream.wanted_hz:g} Hz",
        fail=share < LEAST_SHARE or late,
        warn=share < RATE_SHARE,
    )


def _timesync(autopilot: Autopilot) -> Check:
    sync = autopilot.timesync
    if sync.median_ms is None or sync.max_ms is None:
        return Check(Level.FAIL, "TIMESYNC", "no answer", "answers: without them unix stamps cannot be placed in time")
    found = f"{sync.answered} of {sync.asked} answered, median {sync.median_ms:.1f} ms, longest {sync.max_ms:.1f} ms"
    return grade(
        "TIMESYNC",
        found,
        f"at most {SLOW_ROUND_TRIP_MS:g} ms",
        fail=not sync.settled,
        warn=sync.median_ms > SLOW_ROUND_TRIP_MS,
    )


def _date(autopilot: Autopilot) -> Check:
    """The autopilot's date against ours: what a sensor host that keeps GPS time would be off by."""
    off_s = autopilot.unix_minus_ours_s
    if off_s is None:
        return skip("vehicle date", "the autopilot tells none (no SYSTEM_TIME, or without GPS)")
    found = f"autopilot's date {_signed_ms(off_s)} of this machine's"
    return grade("vehicle date", found, f"within {1e3 * MAX_AHEAD_S:.0f} ms", warn=abs(off_s) > MAX_AHEAD_S)


def zenoh_checks(zenoh: Zenoh, link: Link, config: Config) -> Iterator[Check]:
    """Every source that is heard, every one that is required and is not, and the clocks of both."""
    if zenoh.error is not None:
        yield Check(Level.FAIL, "zenoh", zenoh.error, "a session that opens")
        return
    if config.vehicle.source == "zenoh":
        wanted = float(config.rate_hz)
        share = zenoh.vehicle_hz / wanted
        found, expected = f"{zenoh.vehicle_hz:.1f} Hz", f"{wanted:g} Hz"
        yield grade("vehicle/state", found, expected, fail=share < LEAST_SHARE, warn=share < RATE_SHARE)
    heard = {source.name for source in zenoh.sources}
    missing = [name for name in config.obstacles.required if name not in heard]
    for name in missing:
        yield Check(Level.FAIL, f"source {name}", "nothing", f"frames on {zenoh.prefix}/obstacles/{name}: required")
    for source in zenoh.sources:
        yield _source(source, config)
        yield _clock(source, config)
    traffic = ", ".join(f"{count} {name}" for name, count in sorted(link.traffic.items()))
    if traffic:
        yield grade("traffic", f"{traffic} over MAVLink", "")
    if not zenoh.sources and not missing and not traffic:
        yield Check(Level.WARN, "sources", "no obstacle source", "at least one: what nobody reports is not avoided")


def _source(source: Source, config: Config) -> Check:
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(source.rejected.items()))
    rejected = sum(source.rejected.values())
    slow = source.name in config.obstacles.required and source.rate_hz * config.obstacles.silent_s < 1.0
    found = f"{source.frames} frames, {source.rate_hz:.1f} Hz"
    found += f", the daemon would reject {reasons}" if reasons else ""
    expected = "none rejected"
    if source.name in config.obstacles.required:
        expected += f", one at least every {config.obstacles.silent_s:g} s"
    fail = slow or rejected > ALL_REJECTED_SHARE * source.frames
    return grade(f"source {source.name}", found, expected, fail=fail, warn=rejected > 0)


def _clock(source: Source, config: Config) -> Check:
    """Skew and latency of a sensor host cannot be told apart from one side; a stamp ahead of us is skew for certain."""
    name, least_s, greatest_s = f"clock of {source.name}", source.least_age_s, source.greatest_age_s
    if least_s is None or greatest_s is None:
        return skip(name, "its stamps cannot be placed in time (nothing usable, or no TIMESYNC)")
    most_s = config.obstacles.max_age_s
    clocks = " and ".join(source.clocks)
    found = f"{clocks} stamps {1e3 * least_s:.1f} .. {1e3 * greatest_s:.1f} ms old on arrival"
    if least_s < 0.0:
        found += f": that clock is ahead by {-1e3 * least_s:.1f} ms or more"
    return grade(
        name,
        found,
        f"{-1e3 * AHEAD_S:g} .. {1e3 * most_s:g} ms",
        fail=least_s < -MAX_AHEAD_S or least_s > most_s,
        warn=least_s < -AHEAD_S or greatest_s > most_s,
    )


def machine_checks(machine: Machine) -> Iterator[Check]:
    """Artefact, solvers, deadline, secrets."""
    if machine.artifact_error is not None:
        yield Check(Level.FAIL, "artifact", machine.artifact_error, "an artefact that fits the contract")
    else:
        digest = (machine.artifact_digest or "")[:12]
        yield grade("artifact", f"{machine.artifact}, manifest {digest}", "fits the contract")
    for name, error in machine.solvers.items():
        yield grade(
            f"solver {name}", error or "answers", "the known minimum of a small program", fail=error is not None
        )
    deadline = machine.deadline
    if deadline is None:
        yield skip("deadline", machine.deadline_error or "no artefact to fly with")
    else:
        yield grade(
            "deadline",
            f"a step with {deadline.obstacles} obstacles takes {deadline.p50_ms:.2f} ms (p50),"
            f" {deadline.p99_ms:.2f} ms (p99), {deadline.max_ms:.2f} ms (max of {deadline.steps})",
            f"p99 at most {BUSY_SHARE * deadline.period_ms:g} ms, half of the tick period",
            fail=deadline.p99_ms > deadline.period_ms,
            warn=deadline.p99_ms > BUSY_SHARE * deadline.period_ms,
        )
    for secret in machine.secrets:
        if secret.mode is None:
            yield Check(Level.FAIL, secret.key, f"{secret.path} does not exist", "a file of mode 0600")
        else:
            open_to_others = secret.mode & 0o077 != 0
            yield grade(secret.key, f"{secret.path} has mode {secret.mode:04o}", "0600 or less", fail=open_to_others)


def _signed_ms(seconds: float) -> str:
    return f"{abs(1e3 * seconds):.0f} ms {'ahead' if seconds >= 0.0 else 'behind'}"
