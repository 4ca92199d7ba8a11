"""What a tick and a status say to the outside: Zenoh, the log and its hash."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

import msgspec

from companion.config import Config
from companion.link import wire
from companion.link.zenoh import ZenohLink
from companion.metrics import TickMeter
from companion.pilot import PilotOutput
from companion.record import Recorder
from companion.report import FlightHash, tracks_out, vehicle_out
from companion.scene_log import SceneLog
from companion.session import VehicleSession
from companion.state import State
from companion.tracking.agility import AGILE
from companion.types import NS_PER_S, DetectionFrame, TrackTable, Vec3, VehicleState

log = logging.getLogger("companion")

STATUS_NS = NS_PER_S // 5


class Publisher:
    """Publishes and logs; the record goes out first, because in lockstep the simulator waits for it."""

    def __init__(self, zenoh: ZenohLink, recorder: Recorder | None, scenes: SceneLog | None = None) -> None:
        self._zenoh = zenoh
        self._scenes = scenes
        self._recorder = recorder
        self._hash = FlightHash()
        self._verdict = "silent"
        self._tracks = 0
        self._agile: list[str] = []
        self._last: tuple[int, object] | None = None

    @property
    def log_counts(self) -> dict[str, int]:
        """Messages that did not get into the log; empty without one."""
        return {} if self._recorder is None else dict(self._recorder.counts)

    @property
    def log_hash(self) -> str:
        return self._hash.hexdigest()

    def tick(
        self,
        record: wire.SetpointRecord,
        state: State,
        vehicle: VehicleState,
        frames: tuple[DetectionFrame, ...],
        output: PilotOutput | None,
        tracks: Callable[[], TrackTable],
        arrived_unix_ns: int | None = None,
        target_enu: Vec3 | None = None,
    ) -> None:
        """One tick's record, vehicle and tracks; ``tracks`` is asked after the record has left.

        ``arrived_unix_ns``: when the vehicle state came.
        """
        self._verdict = record.verdict
        payload = wire.encode(record)
        self._zenoh.put_encoded("companion/setpoint", payload)
        table = tracks()
        self._tracks = len(table)
        self._agile = [name for name, agile in zip(table.ids, (table.growth >= AGILE).tolist(), strict=True) if agile]
        if self._recorder is not None:
            self._recorder.frames(frames, vehicle.stamp_ns)
            self._recorder.message("/companion/setpoint", vehicle.stamp_ns, payload)
        self._offer("companion/vehicle", vehicle.stamp_ns, lambda: vehicle_out(vehicle, arrived_unix_ns))
        if output is not None:
            self._offer("companion/tracks", vehicle.stamp_ns, lambda: tracks_out(output, table))
        if self._scenes is not None:
            self._scenes.tick(record, vehicle, output, table, target_enu)
        self._hash.tick(state, vehicle, frames, output, table)

    def _offer(self, key: str, stamp_ns: int, build: Callable[[], msgspec.Struct]) -> None:
        """Build and encode once for whoever wants it: subscribers, the log, or nobody."""
        wanted = self._zenoh.wanted(key)
        if wanted:
            payload = wire.encode(build())
            self._zenoh.put_encoded(key, payload)
            if self._recorder is not None:
                self._recorder.message(f"/{key}", stamp_ns, payload)
        elif self._recorder is not None:
            self._recorder.later(f"/{key}", stamp_ns, build)

    def configured(self, config: Config, stamp_ns: int) -> None:
        """The profile is settled, or live parameters changed: the log says what holds from here on."""
        if self._recorder is not None:
            self._recorder.config(config, stamp_ns)
        if self._scenes is not None:
            self._scenes.configured(config)

    def keep_log(self) -> str | None:
        """The tick is over: let the log be written. What has befallen it since the last call, or None."""
        if self._recorder is None:
            return None
        self._recorder.kick()
        return self._recorder.trouble()

    def status(
        self,
        now_ns: int,
        vehicle_ns: int,
        session: VehicleSession,
        *,
        target_enu: Vec3 | None,
        counts: Callable[[], Mapping[str, int]],
        meter: TickMeter,
    ) -> None:
        """The status, at 5 Hz and whenever the situation or the target changed."""
        situation = session.situation
        target = None if target_enu is None else tuple(target_enu.tolist())
        key = (situation, target, session.watch.notices.standing)
        changed = self._last is None or self._last[1] != key
        if not changed and self._last is not None and now_ns - self._last[0] < STATUS_NS:
            return
        self._last = (now_ns, key)
        if changed:
            log.info("%s (%s)", situation.state, situation.reason)
        status = wire.Status(
            state=situation.state.value,
            reason=situation.reason,
            vehicle_mode="unknown" if session.custom_mode is None else str(session.custom_mode),
            engaged=situation.engaged,
            armed=session.armed,
            airborne=situation.airborne,
            profile=session.config.vehicle.profile,
            warnings=list(session.watch.notices.standing),
            target=target,
            tracks=self._tracks,
            agile=self._agile,
            verdict=self._verdict,
            counts=dict(counts()),
            tick_ms=meter.quantiles_ms(last=1000),
        )
        self._zenoh.put("companion/status", status)
        if self._recorder is not None:
            self._recorder.message("/companion/status", vehicle_ns, wire.encode(status))
