"""The doors of Zenoh: what the daemon does with each incoming key (design 3.2)."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from companion.config import Config, config_hash
from companion.errors import FrameRejected
from companion.frames import enu_from_ned
from companion.link import ingress, ros2, wire
from companion.link.inbox import ObstacleInbox
from companion.link.zenoh import ZenohHandlers
from companion.metrics import TickMeter
from companion.route import Route
from companion.session import VehicleSession
from companion.state import State
from companion.types import VehicleState, frozen


class Doors:
    """Answers targets, engagement and queries; passes obstacles and vehicle states on.

    Args:
        now_ns: the time base of the session.
        on_vehicle: called with each vehicle state that came by Zenoh.
        on_change: called after anything that may let the control task go on.
    Raises:
        ConfigError: topics of ROS 2 are configured and cannot be read here.
    """

    def __init__(
        self,
        config: Config,
        session: VehicleSession,
        route: Route,
        inbox: ObstacleInbox,
        meter: TickMeter,
        *,
        now_ns: Callable[[], int],
        on_vehicle: Callable[[VehicleState], None],
        on_change: Callable[[], None],
    ) -> None:
        self._config = config
        self._session = session
        self._route = route
        self._inbox = inbox
        self._meter = meter
        self._now_ns = now_ns
        self._on_vehicle = on_vehicle
        self._on_change = on_change
        self._ros2 = ros2.subscriptions(config.ros2, inbox)

    def retune(self, config: Config) -> None:
        """What the configuration query answers from now on."""
        self._config = config

    def handlers(self) -> ZenohHandlers:
        lockstep = self._config.sync == "lockstep"
        by_zenoh = self._config.vehicle.source == "zenoh"
        return ZenohHandlers(
            on_obstacles=self._frame_in_lockstep if lockstep else self._inbox.push,
            on_target=self.target,
            on_engage=self.engage,
            config=self._config_json,
            health=self._health_json,
            on_marker=self._marker if lockstep else None,
            on_vehicle=self._vehicle if by_zenoh else None,
            on_rejected=self._inbox.reject,
            extra=self._ros2,
        )

    def target(self, command: wire.TargetCommand) -> wire.Reply:
        """A new target or route; the reply says why not."""
        if (command.position is None) == (command.waypoints is None):
            return wire.Reply(accepted=False, reason="expected one of position and waypoints")
        if command.yaw is not None:
            return wire.Reply(accepted=False, reason="yaw: expected null, the heading is held")
        points = command.waypoints if command.position is None else [command.position]
        convert = enu_from_ned if command.frame == "local_ned" else np.asarray
        refused = self._route.set_waypoints([frozen(convert(point)) for point in points or []])
        return wire.Reply(accepted=refused is None, reason=refused or "")

    def engage(self, command: wire.EngageCommand) -> wire.Reply:
        """Engage or release; the reply says why not."""
        if command.engaged:
            refused = self._session.engage(self._now_ns())
            self._on_change()
            return wire.Reply(accepted=refused is None, reason=refused or "")
        self._session.release(self._now_ns())
        self._on_change()
        return wire.Reply(accepted=True)

    def _frame_in_lockstep(self, source: str, payload: bytes, encoding: str) -> None:
        self._inbox.push(source, payload, encoding)
        self._on_change()

    def _marker(self, source: str, payload: bytes, encoding: str) -> None:
        self._inbox.push_marker(source, payload, encoding)
        self._on_change()

    def _vehicle(self, payload: bytes, encoding: str) -> None:
        try:
            vehicle = ingress.vehicle_from_payload(wire.decode(payload, wire.VehicleStateIn, encoding))
        except FrameRejected as error:
            self._inbox.reject("vehicle/state", error)
            return
        self._on_vehicle(vehicle)

    def _config_json(self) -> bytes:
        config = self._session.config  # with the profile that `auto` came to
        return msgspec.json.encode({"hash": config_hash(config), "config": msgspec.to_builtins(config)})

    def _health_json(self) -> bytes:
        situation = self._session.situation
        healthy = situation.fresh and situation.state is not State.FAULT
        body = {"healthy": healthy, "state": situation.state.value, "reason": situation.reason}
        return msgspec.json.encode({**body, "tick_ms": self._meter.quantiles_ms(last=1000)})
