"""What the doctor saw, as values: the checks read these and nothing else.

Everything is optional where a flight may lack it; ``None`` always means: not seen, never: zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT


@dataclass(frozen=True, slots=True)
class Stream:
    """One message of the autopilot over the measuring window."""

    wanted_hz: float
    heard_hz: float
    longest_gap_s: float | None  # None below two messages
    ack: int | None = None  # MAV_RESULT of SET_MESSAGE_INTERVAL, None without an answer or where none was asked
    measured_s: float | None = None  # over which it was counted, None: the whole measuring window


@dataclass(frozen=True, slots=True)
class Timesync:
    """Round trips of the TIMESYNC requests that were answered [ms]."""

    asked: int
    answered: int
    median_ms: float | None
    max_ms: float | None
    settled: bool  # the daemon would have a time base


@dataclass(frozen=True, slots=True)
class Fix:
    """One ``--fix NAME=VALUE``. ``refused`` says why nothing was written, ``after`` is what a new read answered."""

    name: str
    wanted: float
    before: float | int | None
    after: float | int | None
    refused: str | None = None

    @property
    def done(self) -> bool:
        return self.refused is None and self.after is not None and same_value(self.after, self.wanted)


@dataclass(frozen=True, slots=True)
class Autopilot:
    """The autopilot that the daemon would fly."""

    system: int
    component: int
    kind: int  # MAV_AUTOPILOT
    custom_mode: int
    armed: bool
    parameters: Mapping[str, float | int]  # those that answered
    unanswered: tuple[str, ...]  # asked for several times
    streams: Mapping[str, Stream]
    timesync: Timesync
    unix_minus_ours_s: float | None = None  # SYSTEM_TIME against this machine's clock, None where it knows no date
    fixes: tuple[Fix, ...] = ()


@dataclass(frozen=True, slots=True)
class Link:
    """The MAVLink side as a whole: ``autopilot`` None where nobody, or nobody in particular, was heard."""

    url: str
    autopilot: Autopilot | None
    error: str | None = None  # why it could not be opened
    bytes_in: int = 0
    systems: tuple[int, ...] = ()  # of all autopilots heard
    traffic: Mapping[str, int] = field(default_factory=dict)  # obstacle messages by name


@dataclass(frozen=True, slots=True)
class Source:
    """One obstacle source on Zenoh. Ages are our clock at arrival minus the stamp [s]."""

    name: str
    frames: int
    rate_hz: float
    clocks: tuple[str, ...]
    least_age_s: float | None  # None where the stamps cannot be placed in time
    greatest_age_s: float | None
    rejected: Mapping[str, int] = field(default_factory=dict)  # by the daemon's own reasons


@dataclass(frozen=True, slots=True)
class Zenoh:
    """What was heard below the prefix."""

    prefix: str
    sources: tuple[Source, ...] = ()
    vehicle_hz: float = 0.0  # of vehicle/state
    error: str | None = None


@dataclass(frozen=True, slots=True)
class Deadline:
    """Times of whole brain steps on this machine [ms]."""

    steps: int
    obstacles: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    period_ms: float


@dataclass(frozen=True, slots=True)
class SecretFile:
    """A configured file that holds a secret; ``mode`` None where it does not exist."""

    key: str
    path: str
    mode: int | None


@dataclass(frozen=True, slots=True)
class Machine:
    """What needs no vehicle. Errors are one line each, None where it works."""

    artifact: str  # as configured
    artifact_digest: str | None
    artifact_error: str | None
    solvers: Mapping[str, str | None]  # name -> error
    deadline: Deadline | None
    deadline_error: str | None
    secrets: tuple[SecretFile, ...] = ()


@dataclass(frozen=True, slots=True)
class Observation:
    """Everything; ``measured_s`` is the length of the measuring window."""

    measured_s: float
    link: Link
    zenoh: Zenoh
    machine: Machine


def same_value(a: float, b: float) -> bool:
    """Equal as a parameter: it travels as a 32-bit float.

    >>> same_value(0.30000001192092896, 0.3), same_value(4, 5)
    (True, False)
    """
    return abs(a - b) <= 1e-6 * max(1.0, abs(a), abs(b))
