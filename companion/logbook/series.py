"""A flight's log as time series: what the tables, the summary and the picture are made of."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import TypeVar

import msgspec
import numpy as np

from companion.link.wire import RowOut, SetpointRecord, Status, TracksOut, VehicleOut
from companion.logbook.reader import FlightLog, LogMessage, LogUnreadable
from companion.record import TextOut
from companion.types import NS_PER_S, FloatArray

SETPOINT, VEHICLE, TRACKS = "/companion/setpoint", "/companion/vehicle", "/companion/tracks"
STATUS, TEXTS = "/companion/status", "/companion/texts"

T = TypeVar("T", bound=msgspec.Struct)


@dataclass(frozen=True, slots=True)
class Stretch:
    """One track over time. ``clearance_m``: from its surface to the vehicle's, as the daemon saw both."""

    id: str
    t_s: FloatArray
    p_enu: FloatArray  # (N, 3) [m]
    clearance_m: FloatArray
    confirmed: list[bool]


@dataclass(slots=True)
class Series:
    """Everything of a flight by tick; ``t_s`` counts from the first, and goes on where the vehicle's clock restarts.

    ``records`` are without their rows but the worst.
    """

    records: list[SetpointRecord] = field(default_factory=list)
    t_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    vehicle_t_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    p_enu: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    v_enu: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    tracks: list[Stretch] = field(default_factory=list)
    texts: list[tuple[float, TextOut]] = field(default_factory=list)
    last_status: Status | None = None
    target: tuple[float, float, float] | None = None  # the last one
    restarts: int = 0  # of the vehicle's clock
    topics: Counter[str] = field(default_factory=Counter)

    def closest(self) -> tuple[float, str, float] | None:
        """Least clearance to a confirmed track [m], which, and when [s]."""
        found = [
            (float(clearance), track.id, float(t))
            for track in self.tracks
            for clearance, t, confirmed in zip(track.clearance_m, track.t_s, track.confirmed, strict=True)
            if confirmed
        ]
        return min(found, default=None)


def load_series(log: FlightLog) -> Series:
    """Read the whole log.

    Raises:
        LogUnreadable: a message is not what its topic promises, in this version's terms.
    """
    return _Loader(log).load()


def decode(log: FlightLog, message: LogMessage, kind: type[T]) -> T:
    """A message as the struct of its topic; raises LogUnreadable."""
    try:
        return msgspec.json.decode(message.data, type=kind)
    except msgspec.DecodeError as error:
        raise LogUnreadable(f"{log.path}: {message.topic} at {message.stamp_ns} ns: {error}") from None


class _Timeline:
    """Vehicle stamps to seconds since the first, without steps back."""

    def __init__(self) -> None:
        self.restarts = 0
        self._base_ns = 0  # what lies before the newest start of the vehicle's clock
        self._first_ns: int | None = None
        self._newest_ns = 0

    def tick(self, stamp_ns: int) -> float:
        """Called with each tick in order."""
        if self._first_ns is None:
            self._first_ns = self._newest_ns = stamp_ns
        elif stamp_ns < self._newest_ns - NS_PER_S:
            self.restarts += 1
            self._base_ns += self._newest_ns - self._first_ns
            self._first_ns = stamp_ns
        self._newest_ns = stamp_ns
        return self.at(stamp_ns)

    def at(self, stamp_ns: int) -> float:
        first_ns = stamp_ns if self._first_ns is None else self._first_ns
        return (self._base_ns + stamp_ns - first_ns) / NS_PER_S


class _Loader:
    def __init__(self, log: FlightLog) -> None:
        self._log = log
        self._series = Series()
        self._time = _Timeline()
        self._t_s: list[float] = []
        self._vehicle: list[tuple[float, ...]] = []
        self._seen: dict[str, list[tuple[float, ...]]] = defaultdict(list)
        self._position: tuple[int, tuple[float, float, float]] | None = None

    def load(self) -> Series:
        handlers = {
            SETPOINT: self._on_setpoint,
            VEHICLE: self._on_vehicle,
            TRACKS: self._on_tracks,
            STATUS: self._on_status,
            TEXTS: self._on_text,
        }
        for message in self._log.messages():
            self._series.topics[message.topic] += 1
            handler = handlers.get(message.topic)
            if handler is not None:
                handler(message)
        series = self._series
        series.t_s = np.array(self._t_s)
        vehicle = np.array(self._vehicle).reshape(-1, 7)
        series.vehicle_t_s, series.p_enu, series.v_enu = vehicle[:, 0], vehicle[:, 1:4], vehicle[:, 4:7]
        series.restarts = self._time.restarts
        series.tracks = [_stretch(name, rows) for name, rows in self._seen.items()]
        return series

    def _on_setpoint(self, message: LogMessage) -> None:
        record = decode(self._log, message, SetpointRecord)
        self._t_s.append(self._time.tick(record.stamp_ns))
        self._series.records.append(msgspec.structs.replace(record, rows=[]))  # an hour of rows is a lot of memory

    def _on_vehicle(self, message: LogMessage) -> None:
        vehicle = decode(self._log, message, VehicleOut)
        self._position = (vehicle.stamp_ns, vehicle.position)
        self._vehicle.append((self._time.at(vehicle.stamp_ns), *vehicle.position, *vehicle.velocity))

    def _on_tracks(self, message: LogMessage) -> None:
        told = decode(self._log, message, TracksOut)
        if self._position is None or self._position[0] != told.stamp_ns:
            return
        t_s, own = self._time.at(told.stamp_ns), self._position[1]
        radius_m = self._log.drone_radius_m
        for track in told.tracks:
            between = float(np.linalg.norm(np.subtract(track.position, own)))
            clearance_m = between - track.radius - radius_m
            self._seen[track.id].append((t_s, *track.position, clearance_m, float(track.status != "tentative")))

    def _on_status(self, message: LogMessage) -> None:
        status = decode(self._log, message, Status)
        self._series.last_status = status
        self._series.target = status.target or self._series.target

    def _on_text(self, message: LogMessage) -> None:
        text = decode(self._log, message, TextOut)
        self._series.texts.append((self._time.at(text.stamp_ns), text))


def _stretch(name: str, rows: list[tuple[float, ...]]) -> Stretch:
    table = np.array(rows)
    return Stretch(name, table[:, 0], table[:, 1:4], table[:, 4], [bool(x) for x in table[:, 5]])


def worst_margins(records: list[SetpointRecord]) -> FloatArray:
    """Radii, cushion, sigma and delay of each tick's worst row [m], shape (N, 4); NaN where it is no obstacle's."""
    table = np.full((len(records), 4), np.nan)
    for index, record in enumerate(records):
        if record.worst is not None and record.worst.margin is not None:
            margin = record.worst.margin
            table[index] = (margin.radii, margin.cushion, margin.sigma, margin.delay)
    return table


def epsilons(records: list[SetpointRecord]) -> tuple[FloatArray, FloatArray]:
    """Epsilon and epsilon* of each tick's worst obstacle row; NaN where there is none."""

    def of(row: RowOut | None, name: str) -> float:
        return float("nan") if row is None or row.margin is None else float(getattr(row, name))

    return (
        np.array([of(record.worst, "epsilon") for record in records]),
        np.array([of(record.worst, "epsilon_star") for record in records]),
    )


def norms(values: list[tuple[float, float, float] | None]) -> FloatArray:
    """Length of each vector, NaN where there is none."""
    return np.array([float("nan") if value is None else float(np.linalg.norm(value)) for value in values])
