"""From the brain's answer to the records that go out by Zenoh and into the log."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping

import numpy as np

from companion.link.wire import MarginOut, RowOut, SetpointRecord, TrackOut, TracksOut, Vec, VehicleOut
from companion.pilot import PilotOutput
from companion.state import State
from companion.types import DetectionFrame, RowRecord, TrackTable, Vec3, VehicleState, Verdict

_UPPER = np.triu_indices(6)


def setpoint_record(
    stamp_ns: int,
    state: State,
    output: PilotOutput | None,
    *,
    sent: bool,
    messages: int,
    timings_ms: Mapping[str, float],
) -> SetpointRecord:
    """The intervention record of one tick; without an ``output`` the verdict is ``silent``."""
    result = None if output is None else output.result
    return SetpointRecord(
        stamp_ns=stamp_ns,
        sent=sent,
        messages=messages,
        state=state.value,
        verdict=(Verdict.SILENT if result is None else result.verdict).value,
        u_ref=None if output is None else _vec(output.u_ref),
        u_safe=None if result is None else _vec(result.a_safe),
        wire=_vec(output.wire) if output is not None and sent else None,
        rows=[] if result is None else [_row(row) for row in result.rows],
        worst=None if result is None or result.worst is None else _row(result.worst),
        disturbance=(0.0, 0.0, 0.0) if output is None else _vec(output.disturbance),
        tracks=0 if output is None else len(output.prediction),
        timings_ms=dict(timings_ms),
        detour=result is not None and result.detour,
    )


def vehicle_out(vehicle: VehicleState, arrived_unix_ns: int | None = None) -> VehicleOut:
    w, x, y, z = vehicle.q_enu_from_flu.tolist()
    return VehicleOut(
        stamp_ns=vehicle.stamp_ns,
        position=_vec(vehicle.p_enu),
        velocity=_vec(vehicle.v_enu),
        attitude=(w, x, y, z),
        reset_counter=vehicle.reset_counter,
        arrived_unix_ns=arrived_unix_ns,
    )


def tracks_out(output: PilotOutput, table: TrackTable) -> TracksOut:
    prediction = output.prediction
    predicted = dict(zip(prediction.ids, prediction.p_enu.tolist(), strict=True))
    covariances = table.covariance[:, :6, :6][:, _UPPER[0], _UPPER[1]].tolist()
    rows = zip(
        table.ids,
        table.p_enu.tolist(),
        table.v_enu.tolist(),
        table.a_enu.tolist(),
        table.radius_m.tolist(),
        covariances,
        table.mode_probabilities.tolist(),
        table.status,
        table.sources,
        table.surprise.tolist(),
        table.growth.tolist(),
        strict=True,
    )
    return TracksOut(
        stamp_ns=output.stamp_ns,
        tracks=[
            TrackOut(
                id=name,
                position=tuple(p),
                velocity=tuple(v),
                acceleration=tuple(a),
                radius=radius,
                covariance=covariance,
                mode_probabilities=tuple(mu),
                predicted=[tuple(q) for q in predicted.get(name, [])],
                status=status,
                sources=list(sources),
                surprise=surprise,
                growth=growth,
            )
            for name, p, v, a, radius, covariance, mu, status, sources, surprise, growth in rows
        ],
    )


class FlightHash:
    """SHA-256 over inputs, state, tracks, u_ref, u_safe, verdict and rows in tick order, no wall-clock field."""

    def __init__(self) -> None:
        self._sha = hashlib.sha256()

    def tick(
        self,
        state: State,
        vehicle: VehicleState,
        frames: tuple[DetectionFrame, ...],
        output: PilotOutput | None,
        table: TrackTable,
    ) -> None:
        add = self._sha.update
        add(struct.pack("<q", vehicle.stamp_ns) + state.value.encode())
        add(vehicle.p_enu.tobytes() + vehicle.v_enu.tobytes() + vehicle.q_enu_from_flu.tobytes())
        if vehicle.reset_counter is not None:
            add(struct.pack("<q", vehicle.reset_counter))
        for frame in frames:
            add(struct.pack("<q", frame.stamp_ns) + frame.source.encode())
            for seen in frame.detections:
                add(str(seen.id).encode() + seen.p_enu.tobytes() + struct.pack("<d", seen.radius_m))
        if output is None:
            return
        result = output.result
        add("\0".join(table.ids).encode() + table.p_enu.tobytes() + table.v_enu.tobytes())
        add(table.covariance.tobytes() + table.mode_probabilities.tobytes())
        add(output.u_ref.tobytes() + result.a_safe.tobytes() + output.wire.tobytes())
        add(result.verdict.value.encode())
        for row in result.rows:
            add(row.track.encode() + struct.pack("<iddd", row.step, row.slack, row.epsilon, row.epsilon_star))

    def hexdigest(self) -> str:
        return self._sha.hexdigest()


def _vec(v: Vec3) -> Vec:
    x, y, z = v.tolist()
    return (x, y, z)


def _row(row: RowRecord) -> RowOut:
    margin = row.margin
    return RowOut(
        track=row.track,
        step=row.step,
        slack=row.slack,
        margin=None
        if margin is None
        else MarginOut(radii=margin.radii, cushion=margin.cushion, sigma=margin.sigma, delay=margin.delay),
        epsilon=row.epsilon,
        epsilon_star=row.epsilon_star,
    )
