"""Draws the flight into its log at a limited rate; the drawing is done on the writer's thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from companion.config import Config
from companion.link.geo import TangentPlane
from companion.link.wire import SetpointRecord, encode
from companion.pilot import PilotOutput
from companion.record import Message, Recorder
from companion.report import tracks_out, vehicle_out
from companion.scene import Artist, Moment
from companion.types import NS_PER_S, TrackTable, Vec3, VehicleState

TRACK_BYTES = 4096  # about what a track holds on to until it is drawn


class SceneLog:
    """At most ``log.scene_hz`` pictures a second of vehicle time.

    Args:
        origin: of the local frame on earth, None while it is unknown.
    """

    def __init__(self, recorder: Recorder, config: Config, origin: Callable[[], TangentPlane | None]) -> None:
        self._recorder = recorder
        self._origin = origin
        self._artist = Artist()
        self._every_ns = round(NS_PER_S / config.log.scene_hz)
        self._drawn_ns: int | None = None
        self.configured(config)

    def configured(self, config: Config) -> None:
        """Radius and arena are those of ``config`` from now on."""
        self._radius_m = config.safety.drone_radius_m
        self._arena = (config.limits.arena_min, config.limits.arena_max)

    def tick(
        self,
        record: SetpointRecord,
        vehicle: VehicleState,
        output: PilotOutput | None,
        table: TrackTable,
        target_enu: Vec3 | None,
    ) -> None:
        """Draw this tick if it is time to."""
        stamp_ns = vehicle.stamp_ns
        if self._drawn_ns is not None and 0 <= stamp_ns - self._drawn_ns < self._every_ns:
            return
        self._drawn_ns = stamp_ns
        radius_m, arena, origin = self._radius_m, self._arena, self._origin()

        def draw() -> Iterator[Message]:
            moment = Moment(
                vehicle=vehicle_out(vehicle),
                record=record,
                tracks=None if output is None else tracks_out(output, table),
                target=None if target_enu is None else tuple(target_enu.tolist()),
                drone_radius_m=radius_m,
                arena=arena,
                origin=origin,
            )
            for topic, message in self._artist.draw(moment):
                yield topic, stamp_ns, encode(message)

        self._recorder.batch(draw, TRACK_BYTES * (1 + len(table)))
