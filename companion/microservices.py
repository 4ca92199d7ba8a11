"""The standard MAVLink services of component 196: parameters, requests for messages, threats, the computer's load.

Whatever is sent here is sent by ``poll``, which the control task calls: a daemon that is stuck answers nothing.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

from companion import __version__
from companion.clock import Clock
from companion.config import Config
from companion.hostload import HostLoad, Load
from companion.link import identity, mav
from companion.link.events import Command
from companion.link.mavlink import MavlinkCodec
from companion.link.params import ParameterServer, ParamRequest
from companion.parameters import LiveParameters
from companion.pilot import PilotOutput
from companion.session import VehicleSession
from companion.state import State
from companion.threats import threats
from companion.tunables import BY_NAME
from companion.types import NS_PER_S, VehicleState

log = logging.getLogger("companion")

CMD_PREFLIGHT_STORAGE, CMD_REQUEST_AUTOPILOT_CAPABILITIES = 245, 520
MSG_ONBOARD_COMPUTER_STATUS = 390
COLLISION_NS = NS_PER_S
MAX_THREATS = 8  # a second: 250 B/s of a serial line
LOAD_NS = 2 * NS_PER_S

SYSTEM_STATUS = {
    State.WAITING: mav.STATE_BOOT,
    State.READY: mav.STATE_STANDBY,
    State.OVERRIDDEN: mav.STATE_STANDBY,
    State.FAULT: mav.STATE_CRITICAL,
}


class Microservices:
    """Answers and announcements of one daemon.

    Args:
        base: the configuration without stored parameters; ``config``: with them.
        send: puts bytes on every link.
        retune: puts a configuration into force as a whole, or raises ConfigError and changes nothing.
    """

    def __init__(
        self,
        base: Config,
        config: Config,
        codec: MavlinkCodec,
        session: VehicleSession,
        clock: Clock,
        *,
        send: Callable[[bytes], None],
        retune: Callable[[Config], None],
    ) -> None:
        self._codec = codec
        self._session = session
        self._clock = clock
        self._send = send
        self._live = LiveParameters(base, config, apply=retune, announce=self._changed)
        self._params = ParameterServer(
            tuple(BY_NAME), read=self._live.read, write=self._live.write, refused=self._refused
        )
        self._host = HostLoad()
        self._load: Load | None = None
        self._load_ns: int | None = None
        self._latest: tuple[VehicleState, PilotOutput, int] | None = None  # and when it was noted
        self._collision_ns: int | None = None
        self._wanted: dict[int, None] = {}  # messages asked for, an ordered set
        self._messages: dict[int, Callable[[], bytes | None]] = {
            mav.MSG_HEARTBEAT: self.heartbeat,
            identity.MSG_AUTOPILOT_VERSION: lambda: codec.encode(identity.autopilot_version(__version__)),
            identity.MSG_COMPONENT_INFORMATION_BASIC: lambda: codec.encode(
                identity.component_information_basic(__version__, time_boot_ms=self._boot_ms())
            ),
            MSG_ONBOARD_COMPUTER_STATUS: self._computer_status,
        }
        session.commands |= {
            mav.CMD_REQUEST_MESSAGE: self._request_message,
            CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_capabilities,
            CMD_PREFLIGHT_STORAGE: self._storage,
        }

    def adopt(self, profile: str) -> None:
        """`vehicle.profile = "auto"` is settled."""
        self._live.adopt(profile)

    def handle(self, request: ParamRequest) -> None:
        """One message of the parameter protocol."""
        self._params.handle(request)

    def note(self, vehicle: VehicleState, output: PilotOutput | None) -> None:
        """A tick's answer, for the threats."""
        self._latest = None if output is None else (vehicle, output, self._clock.monotonic_ns())

    def heartbeat(self) -> bytes:
        return self._codec.encode_heartbeat(SYSTEM_STATUS.get(self._session.situation.state, mav.STATE_ACTIVE))

    def poll(self) -> None:
        """Send whatever is due. For the control task alone: silence tells that it is stuck."""
        now_ns = self._clock.monotonic_ns()
        for message in self._params.take(now_ns):
            self._send(self._codec.encode(message))
        wanted, self._wanted = self._wanted, {}
        if self._load_ns is None or now_ns - self._load_ns >= LOAD_NS:
            self._load_ns, self._load = now_ns, self._host.read()
            wanted[MSG_ONBOARD_COMPUTER_STATUS] = None
        for message_id in wanted:
            if (data := self._messages[message_id]()) is not None:
                self._send(data)
        if self._collision_ns is None or now_ns - self._collision_ns >= COLLISION_NS:
            self._collision_ns = now_ns
            self._send_threats(now_ns)

    # threats and load

    def _send_threats(self, now_ns: int) -> None:
        """COLLISION for what is on a collision course with a vehicle in the air, the soonest first."""
        if self._latest is None or not self._session.situation.airborne:
            return
        vehicle, output, noted_ns = self._latest
        if now_ns - noted_ns > COLLISION_NS:
            return  # what it saw is over
        safety = self._live.config.safety
        found = threats(
            vehicle,
            output.prediction,
            output.result,
            drone_radius_m=safety.drone_radius_m,
            cushion_m=safety.cushion_m,
        )
        for threat in found[:MAX_THREATS]:
            self._send(
                self._codec.encode_collision(
                    track_number=threat.number,
                    threat_level=threat.level,
                    time_to_minimum_s=threat.time_s,
                    altitude_minimum_m=threat.altitude_m,
                    horizontal_minimum_m=threat.horizontal_m,
                )
            )

    def _computer_status(self) -> bytes | None:
        load = self._load
        if load is None:
            return None
        return self._codec.encode_onboard_computer_status(
            time_boot_ms=self._boot_ms(),
            uptime_ms=load.uptime_ms,
            cpu_percent=load.cpu_percent,
            ram_used_mib=load.ram_used_mib,
            ram_total_mib=load.ram_total_mib,
        )

    def _boot_ms(self) -> int:
        return self._clock.monotonic_ns() // 1_000_000

    # commands

    def _request_message(self, command: Command) -> int:
        wanted = command.params[0]
        if not (math.isfinite(wanted) and wanted == int(wanted)):
            return mav.RESULT_DENIED
        if int(wanted) not in self._messages:
            return mav.RESULT_UNSUPPORTED
        self._wanted[int(wanted)] = None
        return mav.RESULT_ACCEPTED

    def _request_capabilities(self, command: Command) -> int:
        """Deprecated, and still what MAVProxy and older ground stations send."""
        if command.params[0] != 1.0:
            return mav.RESULT_DENIED
        self._wanted[identity.MSG_AUTOPILOT_VERSION] = None
        return mav.RESULT_ACCEPTED

    def _storage(self, command: Command) -> int:
        """MAV_CMD_PREFLIGHT_STORAGE: as its name says, on the ground only; there a slow disk delays nothing."""
        actions = {0.0: self._live.restore, 1.0: self._live.save, 2.0: self._live.reset}
        action = actions.get(command.params[0])
        if action is None:
            return mav.RESULT_UNSUPPORTED
        if self._session.armed:
            self._refused("storage: expected a disarmed vehicle")
            return mav.RESULT_TEMPORARILY_REJECTED
        why = action()
        if why is not None:
            self._refused(why)
            return mav.RESULT_DENIED
        log.info("parameters %s", {0.0: "read", 1.0: "stored", 2.0: "reset"}[command.params[0]])
        return mav.RESULT_ACCEPTED

    # parameters

    def _changed(self, name: str) -> None:
        log.info("parameter %s = %g", name, self._live.read(name))
        self._params.announce(name)

    def _refused(self, why: str) -> None:
        log.warning("refused: %s", why)
        self._session.say(mav.SEVERITY_WARNING, f"refused: {why}")
