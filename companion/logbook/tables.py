"""A flight's log as tables: one a kind of message, one row a tick, track, row of the filter, or obstacle seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

from companion.link.wire import MarginOut, RowOut, SetpointRecord, Status, TracksOut, VehicleOut
from companion.logbook.reader import FlightLog, LogMessage
from companion.logbook.series import SETPOINT, STATUS, TEXTS, TRACKS, VEHICLE, decode
from companion.record import OBSTACLES, TextOut

Row: TypeAlias = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """``columns``: name and type of each (int, float, str or bool); any value may be missing (None)."""

    name: str
    topic: str
    columns: tuple[tuple[str, type], ...]
    rows_of: Callable[[FlightLog, LogMessage], Iterator[Row]]

    def rows(self, log: FlightLog) -> Iterator[Row]:
        """Every row of a log, in the order in which it was written."""
        for message in log.messages(self.topic):
            yield from self.rows_of(log, message)


def _columns(**kinds: str) -> tuple[tuple[str, type], ...]:
    """Columns from ``kind="names"``; a name that ends in ``*`` stands for its x, y and z."""
    types: dict[str, type] = {"integer": int, "number": float, "text": str, "flag": bool}
    found: list[tuple[str, type]] = []
    for kind, names in kinds.items():
        for name in names.split():
            spread = [f"{name[:-1]}{axis}" for axis in "xyz"] if name.endswith("*") else [name]
            found += [(one, types[kind.rstrip("_")]) for one in spread]
    return tuple(found)


def _vec(value: tuple[float, ...] | list[float] | None) -> tuple[float | None, ...]:
    return (None, None, None) if value is None else tuple(value)


def _margin(margin: MarginOut | None) -> Row:
    return (None,) * 4 if margin is None else (margin.radii, margin.cushion, margin.sigma, margin.delay)


def _row(row: RowOut | None) -> Row:
    if row is None:
        return (None,) * 9
    return (row.track, row.step, row.slack, *_margin(row.margin), row.epsilon, row.epsilon_star)


def _setpoints(log: FlightLog, message: LogMessage) -> Iterator[Row]:
    r = decode(log, message, SetpointRecord)
    vectors = (*_vec(r.u_ref), *_vec(r.u_safe), *_vec(r.wire), *_vec(r.disturbance))
    timings = (r.timings_ms.get(name) for name in ("queue", "ahead", "brain", "total"))
    counted = (r.tracks, len(r.rows), r.messages)
    yield (r.stamp_ns, *counted, *vectors, *timings, r.state, r.verdict, r.sent, r.detour, *_row(r.worst))


def _active_rows(log: FlightLog, message: LogMessage) -> Iterator[Row]:
    record = decode(log, message, SetpointRecord)
    for row in record.rows:
        yield (record.stamp_ns, *_row(row))


def _vehicle(log: FlightLog, message: LogMessage) -> Iterator[Row]:
    v = decode(log, message, VehicleOut)
    yield (v.stamp_ns, v.arrived_unix_ns, v.reset_counter, *v.position, *v.velocity, *v.attitude)


def _tracks(log: FlightLog, message: LogMessage) -> Iterator[Row]:
    told = decode(log, message, TracksOut)
    for t in told.tracks:
        sigmas = tuple(max(0.0, t.covariance[index]) ** 0.5 for index in (0, 6, 11))
        moving = (*t.position, *t.velocity, *t.acceleration, *sigmas, t.radius, *t.mode_probabilities)
        yield (told.stamp_ns, *moving, t.surprise, t.growth, t.id, t.status, " ".join(t.sources))


def _obstacles(_log: FlightLog, message: LogMessage) -> Iterator[Row]:
    frame = message.json
    head = (message.stamp_ns, frame["stamp_ns"], frame.get("arrived_unix_ns"), frame["sequence"])
    for seen in frame["obstacles"]:
        about = (seen["radius"], seen.get("position_std"), *_vec(seen.get("velocity")), seen.get("velocity_std"))
        yield (*head, *seen["position"], *about, frame["source"], frame["kind"], seen.get("id"))


def _status(log: FlightLog, message: LogMessage) -> Iterator[Row]:
    s = decode(log, message, Status)
    told = (s.state, s.reason, s.vehicle_mode, s.profile, s.verdict, "; ".join(s.warnings))
    yield (message.stamp_ns, s.tracks, *_vec(s.target), *told, s.engaged, s.armed, s.airborne)


def _texts(log: FlightLog, message: LogMessage) -> Iterator[Row]:
    text = decode(log, message, TextOut)
    yield (text.stamp_ns, text.severity, text.text)


_WORST = (
    ("worst_track", str),
    ("worst_step", int),
    ("worst_slack", float),
    *((f"worst_{name}", float) for name in ("radii", "cushion", "sigma", "delay", "epsilon", "epsilon_star")),
)
_SETPOINT_COLUMNS = _columns(
    integer="stamp_ns tracks rows messages",
    number="u_ref_* u_safe_* wire_* disturbance_* queue_ms ahead_ms brain_ms total_ms",
    text="state verdict",
    flag="sent detour",
)

TABLES = (
    Table("setpoints", SETPOINT, (*_SETPOINT_COLUMNS, *_WORST), _setpoints),
    Table(
        "rows",
        SETPOINT,
        (("stamp_ns", int), *((name.removeprefix("worst_"), kind) for name, kind in _WORST)),
        _active_rows,
    ),
    Table(
        "vehicle",
        VEHICLE,
        _columns(integer="stamp_ns arrived_unix_ns reset_counter", number="* v* q_w q_*"),
        _vehicle,
    ),
    Table(
        "tracks",
        TRACKS,
        _columns(
            integer="stamp_ns",
            number="* v* a* sigma_* radius p_cv p_ca p_ct surprise growth",
            text="id status sources",
        ),
        _tracks,
    ),
    Table(
        "obstacles",
        OBSTACLES,
        _columns(
            integer="tick_ns stamp_ns arrived_unix_ns sequence",
            number="* radius position_std v* velocity_std",
            text="source kind id",
        ),
        _obstacles,
    ),
    Table(
        "status",
        STATUS,
        _columns(
            integer="stamp_ns tracks",
            number="target_*",
            text="state reason vehicle_mode profile verdict warnings",
            flag="engaged armed airborne",
        ),
        _status,
    ),
    Table("texts", TEXTS, _columns(integer="stamp_ns severity", text="text"), _texts),
)
