"""The conversation with the autopilot and the operator: MAVLink events in, state machine events and replies out.

Sans-I/O: time is an argument, bytes to send collect in ``take_outgoing``. ``now_ns`` is vehicle time in lockstep and
the monotonic clock otherwise; only differences of it are used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from companion.config import Config
from companion.confirm import ECHO_HZ
from companion.latch import AutopilotLatch
from companion.link import mav
from companion.link.events import Attitude, Command, Heartbeat, LandedState, Position, SetpointEcho, SetpointHeard
from companion.link.events import Event as LinkEvent
from companion.link.geo import TangentPlane
from companion.link.mavlink import MavlinkCodec
from companion.link.reposition import CommandRefused, OriginUnknown, reposition_target
from companion.modes import ModeRequests
from companion.profiles import BY_AUTOPILOT
from companion.requests import StreamRequests
from companion.state import FLYING, Event, Situation, State, advance, refusal
from companion.texts import TextGate
from companion.types import NS_PER_S, Vec3, VehicleState
from companion.watch import AutopilotWatch

FAULT_RETRY_NS = 5 * NS_PER_S  # on the ground the brain may try again, this often
EXTENDED_SYS_STATE_HZ = 2.0

_SEVERITY = {
    State.FAULT: mav.SEVERITY_CRITICAL,
    State.HOLD: mav.SEVERITY_WARNING,
    State.OVERRIDDEN: mav.SEVERITY_NOTICE,
}


class VehicleSession:
    """Finds the vehicle, keeps the `Situation`, runs the engage and release sequences, answers commands.

    Args:
        on_target: called with a position (ENU) from DO_REPOSITION; returns why it is refused, or None.
        on_profile: called when ``vehicle.profile = "auto"`` is settled, with the configuration that is flown.
    """

    def __init__(
        self,
        config: Config,
        codec: MavlinkCodec,
        on_target: Callable[[Vec3], str | None],
        on_profile: Callable[[Config], None] = lambda config: None,
    ) -> None:
        self.config = config
        self._codec = codec
        self._on_target = on_target
        self._on_profile = on_profile
        self.situation = Situation()
        self.armed = False
        self.custom_mode: int | None = None
        self.origin: Callable[[], TangentPlane | None] = lambda: None  # of the local frame, where somebody knows it
        self.on_text: Callable[[int, str], None] = lambda severity, text: None  # told about each STATUSTEXT sent
        self._attitude: Attitude | None = None
        self._system: int | None = None
        self._component: int | None = None
        self._latch = AutopilotLatch(config.mavlink.system_id)
        self._heartbeat_ns: int | None = None
        self._state_ns: int | None = None
        self._reset_counter: int | None = None  # the newest of the estimator
        self._unknown = ""  # an autopilot for which there is no profile
        self._modes = ModeRequests(config, lambda mode: self._outgoing.append(codec.encode_set_mode(mode)))
        self._streams = StreamRequests(
            lambda message, hz: self._outgoing.append(codec.encode_set_message_interval(message, hz))
        )
        self.watch = AutopilotWatch(config, lambda text: self.say(mav.SEVERITY_WARNING, text))
        self._failed_ns = 0
        self._told: tuple[State, str] | None = None
        self._outgoing: list[bytes] = []
        self._texts = TextGate()
        self.commands: dict[int, Callable[[Command], int]] = {}  # MAV_CMD -> handler; it answers a MAV_RESULT

    # what others ask

    @property
    def system(self) -> int:
        return self._system or self.config.mavlink.system_id or 1

    @property
    def streams(self) -> bool:
        """Whether setpoints go out in this state."""
        state = self.situation.state
        if self.config.mode == "monitor" or self._system is None:
            return False
        return state in FLYING or (state is State.READY and self.config.profile.streams_when_ready)

    @property
    def text_counts(self) -> Counter[str]:
        """STATUSTEXTs that were repeated or dropped."""
        return self._texts.counts

    def retune(self, config: Config) -> None:
        """Time-outs of ``config`` from now on."""
        self.config = config
        self._modes.adopt(config)

    @property
    def flies(self) -> bool:
        """Whether our setpoints fly the vehicle now."""
        return self.situation.state in FLYING

    def take_outgoing(self) -> list[bytes]:
        """Messages to send since the last call, in order."""
        outgoing, self._outgoing = self._outgoing, []
        return outgoing

    def engage(self, now_ns: int) -> str | None:
        """Engage; why it is refused, or None."""
        why = refusal(self.situation)
        if why is None:
            self._event(Event.ENGAGE)
            self._modes.engage()
            if not self.situation.airborne:
                self.situation = replace(self.situation, reason="engaged, waiting to be airborne")
        return why

    def release(self, now_ns: int) -> None:
        self._event(Event.RELEASE)
        self._modes.at_once()
        self._modes.poll_hold(self.situation, now_ns)

    def degraded(self, reason: str | None) -> None:
        """Tell whether the brain's inputs allow flying to the target (None) or only holding."""
        if (reason is not None) != self.situation.degraded:
            self._event(Event.RECOVERED if reason is None else Event.DEGRADED, reason or "")

    def fail(self, reason: str, now_ns: int) -> None:
        """The brain could not answer. Only a vehicle that we were flying is put into its hold mode, and once."""
        self._modes.hold_wanted = self._modes.hold_wanted or self.situation.state in FLYING
        self._event(Event.BRAIN_FAILED, reason)
        self._modes.at_once()
        self._failed_ns = now_ns

    def say(self, severity: int, text: str) -> None:
        """A STATUSTEXT for the operator: at the next `poll`, not twice in a row, never a flood."""
        self._texts.push(severity, text)

    def request_message(self, message: int) -> None:
        """Ask the autopilot, once it is known, for one message."""
        if self._system is not None:
            self._outgoing.append(self._codec.encode_request_message(message))

    def rebooted(self) -> None:
        """The autopilot began anew: it forgot which messages it was asked for."""
        self._streams.restart()
        self.watch.restart()
        self._attitude = self._reset_counter = None

    def sent_setpoint(self, a_enu: Vec3, now_ns: int) -> None:
        """A setpoint left; the autopilot confirms those it obeys."""
        if self._obeyed:
            self.watch.sent(a_enu, now_ns)

    # what comes in

    def handle(self, event: LinkEvent, now_ns: int) -> VehicleState | None:
        """Take one MAVLink event; the vehicle state it completes, if it does."""
        match event:
            case Heartbeat():
                self._on_heartbeat(event, now_ns)
            case Attitude() if self._by_mavlink and self._is_ours(event):
                self._streams.heard(mav.MSG_ATTITUDE_QUATERNION, now_ns)
                self._attitude = event
            case Position() if self._by_mavlink and self._is_ours(event):
                self._streams.heard(mav.MSG_LOCAL_POSITION_NED, now_ns)
                return self._on_position(event)
            case LandedState() if self._is_ours(event):
                self._streams.heard(mav.MSG_EXTENDED_SYS_STATE, now_ns)
                self._on_landed(event)
            case SetpointEcho() if self._is_ours(event):
                self._streams.heard(mav.MSG_POSITION_TARGET_LOCAL_NED, now_ns)
                self.watch.echo(event, now_ns)
            case SetpointHeard() if self._system is not None and self._component is not None:
                self.watch.overheard(event, (self._system, self._component), now_ns)
            case Command():
                self._on_command(event, now_ns)
            case _:
                pass
        return None

    def heard_vehicle(self, now_ns: int) -> None:
        """A vehicle state arrived, from MAVLink or Zenoh."""
        self._state_ns = now_ns

    def poll(self, now_ns: int) -> None:
        """Time passes: freshness, latching, the engage, release and fault sequences, message intervals, STATUSTEXT."""
        if self._system is None:
            self._choose(now_ns)
        fresh = self._is_fresh(now_ns)
        if fresh != self.situation.fresh:
            self._event(Event.VEHICLE_FRESH if fresh else Event.VEHICLE_LOST, self._lost_reason(now_ns))
        elif self.situation.state is State.WAITING:
            self.situation = replace(self.situation, reason=self._lost_reason(now_ns))
        if self._modes.poll_engage(self.situation, now_ns):
            self._event(Event.ENGAGE_TIMEOUT)
            self.say(mav.SEVERITY_WARNING, "engage: autopilot did not enter its external mode")
        self._modes.poll_hold(self.situation, now_ns)
        self._ask_streams(now_ns)
        self.watch.poll(now_ns, obeyed=self._obeyed, engaged=self.situation.engaged)
        self._tell()
        for severity, text in self._texts.take(now_ns):
            self._outgoing.append(self._codec.encode_statustext(severity, text))
            self.on_text(severity, text)

    # details

    @property
    def _by_mavlink(self) -> bool:
        return self.config.vehicle.source == "mavlink"

    @property
    def _obeyed(self) -> bool:
        """Whether setpoints go out to an autopilot that should follow them."""
        return self.streams and self.situation.external

    def _is_ours(self, event: Attitude | Position | LandedState | Heartbeat | SetpointEcho) -> bool:
        """From the autopilot that was latched: other components of its system speak for themselves."""
        return (event.system, event.component) == (self._system, self._component)

    def _event(self, event: Event, detail: str = "") -> None:
        self.situation = advance(self.situation, event, engage_by=self.config.engage_by, detail=detail)

    def _on_heartbeat(self, beat: Heartbeat, now_ns: int) -> None:
        if beat.autopilot == mav.AUTOPILOT_INVALID:
            return
        if self._system is None:
            self._latch.heard(beat, now_ns)
            self._choose(now_ns)
        if not self._is_ours(beat):
            return
        if self._heartbeat_ns is not None and now_ns - self._heartbeat_ns > self._timeout_ns:
            self.rebooted()  # it may have: asking again does no harm
        self._heartbeat_ns = now_ns
        self.watch.heartbeat(beat, now_ns)
        self.custom_mode = beat.custom_mode
        grounded_fault = self.situation.state is State.FAULT and now_ns - self._failed_ns >= FAULT_RETRY_NS
        if not beat.armed and (self.armed or grounded_fault):
            self._event(Event.DISARMED)
        self.armed = beat.armed
        self._on_mode(beat.custom_mode == self.config.profile.external.custom_mode, now_ns)

    def _on_mode(self, external: bool, now_ns: int) -> None:
        if not external:
            self._modes.hold_wanted = False
        if external == self.situation.external:
            return
        if external and self._modes.are_ours(now_ns) and not self.situation.engaged:
            # released while the mode was on its way: it is nobody's switch, and not wanted any more
            self.situation = advance(self.situation, Event.EXTERNAL_ON, engage_by="command")
            self._modes.hold_wanted = True
        else:
            self._event(Event.EXTERNAL_ON if external else Event.EXTERNAL_OFF)

    def _choose(self, now_ns: int) -> None:
        chosen = self._latch.choose(now_ns)
        if chosen is None:
            return
        system, component, autopilot = chosen
        if self.config.vehicle.profile == "auto" and not self._settle_profile(system, autopilot):
            return
        self._system, self._component = system, component
        self._codec.system = system

    def _settle_profile(self, system: int, autopilot: int) -> bool:
        """``vehicle.profile = "auto"``: the profile of what the heartbeat says; False where there is none."""
        profile = BY_AUTOPILOT.get(autopilot)
        if profile is None:
            named = mav.autopilot_name(autopilot)
            self._unknown = f"no profile for {named} (MAV_AUTOPILOT {autopilot}), set vehicle.profile"
            return False
        self.config = self.config.flown_as(profile.name)
        self._modes.adopt(self.config)
        self.watch.adopt(self.config)
        self._on_profile(self.config)
        self.say(mav.SEVERITY_INFO, f"system {system} is {mav.autopilot_name(autopilot)}, profile {profile.name}")
        return True

    def _on_position(self, position: Position) -> VehicleState | None:
        if self._attitude is None:
            return None
        if position.reset_counter is not None:
            self._reset_counter = position.reset_counter
        q_enu_from_flu, counter = self._attitude.q_enu_from_flu, self._reset_counter
        return VehicleState(
            position.stamp_ns, position.p_enu, position.v_enu, q_enu_from_flu, position.p_std_m, counter
        )

    def _on_landed(self, landed: LandedState) -> None:
        if landed.airborne is not None and landed.airborne != self.situation.airborne:
            self._event(Event.AIRBORNE if landed.airborne else Event.LANDED)

    def _on_command(self, command: Command, now_ns: int) -> None:
        result = mav.RESULT_UNSUPPORTED
        if command.command == mav.CMD_NAV_GUIDED_ENABLE:
            if command.params[0] >= 0.5:
                refused = self.engage(now_ns)
                result = mav.RESULT_ACCEPTED if refused is None else mav.RESULT_TEMPORARILY_REJECTED
            else:
                self.release(now_ns)
                result = mav.RESULT_ACCEPTED
        elif command.command == mav.CMD_DO_REPOSITION:
            result = self._reposition(command)
        elif command.command in self.commands:
            result = self.commands[command.command](command)
        self._outgoing.append(self._codec.encode_command_ack(command, result))

    def _reposition(self, command: Command) -> int:
        try:
            target_enu = reposition_target(command, self.origin())
        except CommandRefused as refused:
            if isinstance(refused, OriginUnknown):
                self.request_message(mav.MSG_GPS_GLOBAL_ORIGIN)
            return refused.result
        return mav.RESULT_ACCEPTED if self._on_target(target_enu) is None else mav.RESULT_DENIED

    @property
    def _timeout_ns(self) -> int:
        return int(self.config.mavlink.heartbeat_timeout_s * NS_PER_S)

    def _is_fresh(self, now_ns: int) -> bool:
        if self._heartbeat_ns is None or self._state_ns is None or self._system is None:
            return False
        stale_ns = int(self.config.vehicle.stale_s * NS_PER_S)
        return now_ns - self._heartbeat_ns <= self._timeout_ns and now_ns - self._state_ns <= stale_ns

    def _lost_reason(self, now_ns: int) -> str:
        """Why there is no fresh vehicle; without numbers that change, so that it is told once."""
        if self._system is None and self.config.mavlink.system_id is None and len(self._latch.systems) > 1:
            return f"autopilots {self._latch.systems} heard, set mavlink.system_id"
        if self._system is None and self._unknown:
            return self._unknown
        if self._heartbeat_ns is None:
            return "no heartbeat"
        if now_ns - self._heartbeat_ns > self._timeout_ns:
            return "heartbeat lost"
        return "no vehicle state" if not self._is_fresh(now_ns) else "vehicle fresh"

    def _ask_streams(self, now_ns: int) -> None:
        """SET_MESSAGE_INTERVAL for what does not arrive; a stream that has stopped while heartbeats go on is told."""
        if self._system is None:
            return
        rate_hz = float(self.config.rate_hz)
        wanted = {mav.MSG_EXTENDED_SYS_STATE: EXTENDED_SYS_STATE_HZ}
        if self._by_mavlink:
            wanted |= {mav.MSG_LOCAL_POSITION_NED: rate_hz, mav.MSG_ATTITUDE_QUATERNION: rate_hz}
        if self._obeyed:
            wanted[mav.MSG_POSITION_TARGET_LOCAL_NED] = ECHO_HZ
        stopped = self._streams.poll(wanted, now_ns, self._heartbeat_ns)
        for message in wanted.keys() - {mav.MSG_POSITION_TARGET_LOCAL_NED}:  # that one is `confirm`'s
            name = mav.message_name(message)
            text = f"{name} stopped, asked for again" if message in stopped else None
            self.watch.notices.stand(f"lost_{name}", text, now_ns)

    def _tell(self) -> None:
        """STATUSTEXT when state or reason changed, once each."""
        now = (self.situation.state, self.situation.reason)
        if now != self._told:
            self._told = now
            state, reason = now
            self.say(_SEVERITY.get(state, mav.SEVERITY_INFO), f"companion {state.value}: {reason}")
