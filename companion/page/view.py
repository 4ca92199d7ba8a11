"""What the page shows of one instant: the messages of its WebSocket, made from the brain's values.

Local ENU, SI; numbers are rounded to what a screen can show. At most MAX_TRACKS tracks, the nearest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec import Struct

from companion.link import wire
from companion.pilot import PilotOutput
from companion.types import FloatArray, RowRecord, TrackTable, VehicleState

MAX_TRACKS = 40
PATH_STRIDE = 2  # every other predicted position is drawn

Vec = list[float]


class KeepOut(Struct, frozen=True, kw_only=True):
    """The margin that the filter keeps from one obstacle now: of its row with the least slack."""

    centre: Vec  # where the obstacle is predicted to be at that row's last step [m]
    radii: float  # the parts of D [m]
    cushion: float
    sigma: float
    delay: float
    step: int  # horizon step i; -1: the braking distance
    slack: float  # [m/s^2]
    epsilon: float
    epsilon_star: float


class PageTrack(Struct, frozen=True, kw_only=True):
    """One track."""

    id: str
    p: Vec
    v: Vec
    radius: float
    covariance: Vec  # of the position: xx, xy, xz, yy, yz, zz [m^2]
    status: str
    modes: Vec  # probabilities of CV, CA, CT
    clearance: float  # surface to surface as estimated [m]
    path: list[Vec]  # predicted positions
    keep_out: KeepOut | None


class PageTick(Struct, frozen=True, kw_only=True):
    """One tick of the brain."""

    t: float  # vehicle time [s]
    p: Vec
    v: Vec
    yaw: float  # of the nose, counter-clockwise from east [rad]
    verdict: str
    sent: bool
    detour: bool
    u_ref: Vec | None
    u_safe: Vec | None
    tightest: str | None  # the row with the least slack: whose, and which step
    slack: float | None  # of that row [m/s^2]
    clearance: float | None  # to the nearest confirmed track
    epsilon: float | None  # of the obstacle row with the least slack
    epsilon_star: float | None
    tracks: list[PageTrack]
    hidden: int  # tracks that are not listed


class PageLink(Struct, frozen=True, kw_only=True):
    """A MAVLink link, or a source of obstacles; ``age`` since it was last heard [s], None: never."""

    name: str
    age: float | None
    note: str = ""


class PageFrame(Struct, frozen=True, kw_only=True):
    """One message to the page."""

    vehicle: str
    version: str
    mode: str  # "normal", "monitor"
    commands: bool
    arena: tuple[Vec, Vec]
    drone_radius: float
    speed_limit: float
    period_ms: float
    mode_name: str  # of the autopilot
    route: list[Vec]
    status: wire.Status | None
    tick: PageTick | None
    tick_age: float | None  # [s]
    links: list[PageLink]
    sources: list[PageLink]
    history: list[list[float | None]] | None = None  # rows of `Sample`; in the first message only


@dataclass(frozen=True, slots=True)
class Sample:
    """One point of the charts and of the trail."""

    t_s: float
    clearance_m: float | None
    epsilon: float | None
    epsilon_star: float | None
    speed_m_s: float
    p_enu: tuple[float, float, float]

    def row(self) -> list[float | None]:
        """t, clearance, epsilon, epsilon*, speed, x, y, z."""
        return [self.t_s, self.clearance_m, self.epsilon, self.epsilon_star, self.speed_m_s, *self.p_enu]


@dataclass(frozen=True, slots=True)
class Tick:
    """The values of one tick as the daemon left them."""

    record: wire.SetpointRecord
    vehicle: VehicleState
    output: PilotOutput | None
    table: TrackTable


def sample(tick: Tick, drone_radius_m: float) -> Sample:
    """A tick in eight numbers."""
    clearances = clearances_m(tick, drone_radius_m)
    row = _binding_obstacle(tick.output)
    x, y, z = _rounded(tick.vehicle.p_enu)
    return Sample(
        t_s=round(tick.vehicle.stamp_ns / 1e9, 3),
        clearance_m=_least(clearances[_trusted(tick.table)]),
        epsilon=None if row is None else round(row.epsilon, 4),
        epsilon_star=None if row is None else round(row.epsilon_star, 4),
        speed_m_s=round(float(np.linalg.norm(tick.vehicle.v_enu)), 3),
        p_enu=(x, y, z),
    )


def clearances_m(tick: Tick, drone_radius_m: float) -> FloatArray:
    """(M,) distance from the vehicle to each track, surface to surface."""
    table = tick.table
    distances = np.linalg.norm(table.p_enu.reshape(-1, 3) - tick.vehicle.p_enu, axis=1)
    return np.asarray(distances - table.radius_m - drone_radius_m)


def page_tick(tick: Tick, drone_radius_m: float) -> PageTick:
    """A tick as the page draws it."""
    record, vehicle, output, table = tick.record, tick.vehicle, tick.output, tick.table
    clearances = clearances_m(tick, drone_radius_m)
    shown = np.argsort(clearances, kind="stable")[:MAX_TRACKS].tolist()
    now = sample(tick, drone_radius_m)
    worst = None if output is None else output.result.worst
    w, x, y, z = vehicle.q_enu_from_flu.tolist()
    return PageTick(
        t=now.t_s,
        p=list(now.p_enu),
        v=_rounded(vehicle.v_enu),
        yaw=round(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)), 3),
        verdict=record.verdict,
        sent=record.sent,
        detour=output is not None and output.result.detour,
        u_ref=None if output is None else _rounded(output.u_ref),
        u_safe=None if output is None else _rounded(output.result.a_safe),
        tightest=None if worst is None else _in_words(worst),
        slack=None if worst is None else round(worst.slack, 3),
        clearance=now.clearance_m,
        epsilon=now.epsilon,
        epsilon_star=now.epsilon_star,
        tracks=_tracks(output, table, clearances, shown),
        hidden=len(table) - len(shown),
    )


def _tracks(output: PilotOutput | None, table: TrackTable, clearances: FloatArray, shown: list[int]) -> list[PageTrack]:
    rows = {} if output is None else _worst_by_track(output.result.rows)
    predicted: dict[str, list[Vec]] = {}
    if output is not None:
        paths = np.round(output.prediction.p_enu, 3).tolist()  # all at once: number by number it costs milliseconds
        predicted = dict(zip(output.prediction.ids, paths, strict=True))
    positions, velocities = np.round(table.p_enu, 3).tolist(), np.round(table.v_enu, 3).tolist()
    upper = table.covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    covariances, modes = np.round(upper, 5).tolist(), np.round(table.mode_probabilities, 2).tolist()
    tracks = []
    for j in shown:
        name = table.ids[j]
        path, row = predicted.get(name), rows.get(name)
        tracks.append(
            PageTrack(
                id=name,
                p=positions[j],
                v=velocities[j],
                radius=round(float(table.radius_m[j]), 3),
                covariance=covariances[j],
                status=table.status[j],
                modes=modes[j],
                clearance=round(float(clearances[j]), 3),
                path=[] if path is None else path[::PATH_STRIDE],
                keep_out=None if path is None or row is None else _keep_out(row, path),
            )
        )
    return tracks


def _keep_out(row: RowRecord, path: list[Vec]) -> KeepOut | None:
    margin = row.margin
    if margin is None:
        return None
    last = 0 if row.step < 0 else min(row.step + 2, len(path) - 1)  # D is that of the row's last step
    return KeepOut(
        centre=path[last],
        radii=round(margin.radii, 3),
        cushion=round(margin.cushion, 3),
        sigma=round(margin.sigma, 3),
        delay=round(margin.delay, 3),
        step=row.step,
        slack=round(row.slack, 3),
        epsilon=round(row.epsilon, 3),
        epsilon_star=round(row.epsilon_star, 3),
    )


def _worst_by_track(rows: tuple[RowRecord, ...]) -> dict[str, RowRecord]:
    """The row with the least slack of each obstacle."""
    worst: dict[str, RowRecord] = {}
    for row in rows:
        if row.margin is not None and (row.track not in worst or row.slack < worst[row.track].slack):
            worst[row.track] = row
    return worst


def _binding_obstacle(output: PilotOutput | None) -> RowRecord | None:
    rows = () if output is None else tuple(row for row in output.result.rows if row.margin is not None)
    return min(rows, key=lambda row: row.slack, default=None)


def _in_words(row: RowRecord) -> str:
    return row.track + ("" if row.margin is None else ", braking" if row.step < 0 else f", step {row.step}")


def _trusted(table: TrackTable) -> list[int]:
    return [j for j, status in enumerate(table.status) if status != "tentative"]


def _least(values: FloatArray) -> float | None:
    return round(float(values.min()), 3) if len(values) else None


def _rounded(values: FloatArray) -> Vec:
    rounded: Vec = np.round(values, 3).tolist()
    return rounded


ENCODER = msgspec.json.Encoder()
