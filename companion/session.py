"""The conversation with the autopilot and the operator: MAVLink events in, state machine events and replies out.

Sans-I/O: time is an argument, bytes to send collect in ``take_outgoing``. ``now_ns`` is vehicle time in lockstep and
the monotonic clock otherwise; only differences of it are used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from companion.config import Config
from companion.latch import AutopilotLatch
from companion.link import mav
from companion.link.decode import CommandRefused, reposition_target
from companion.link.events import Attitude, Command, Heartbeat, LandedState, Position
from companion.link.events import Event as LinkEvent
from companion.link.mavlink import MavlinkCodec
from companion.profiles import ModeRequest
from companion.state import FLYING, Event, Situation, State, advance, refusal
from companion.texts import TextGate
from companion.types import NS_PER_S, Vec3, VehicleState

REPEAT_NS = NS_PER_S // 2  # mode requests
INTERVAL_RETRY_NS = 2 * NS_PER_S
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
    """

    def __init__(self, config: Config, codec: MavlinkCodec, on_target: Callable[[Vec3], str | None]) -> None:
        self._config = config
        self._profile = config.profile
        self._codec = codec
        self._on_target = on_target
        self.situation = Situation()
        self.armed = False
        self.custom_mode: int | None = None
        self._attitude: Attitude | None = None
        self._system: int | None = None
        self._component: int | None = None
        self._latch = AutopilotLatch(config.mavlink.system_id)
        self._heartbeat_ns: int | None = None
        self._state_ns: int | None = None
        self._sequence_ns: int | None = None  # start of the engage sequence
        self._requested_ns: int | None = None  # last mode request
        self._asked_ns: dict[int, int] = {}  # message -> last asked for
        self._heard_ns: dict[int, int] = {}  # message -> last arrived
        self._asked_external_ns: int | None = None
        self._hold_wanted = False  # a fault in flight, or an external mode that came after a release
        self._failed_ns = 0
        self._told: tuple[State, str] | None = None
        self._outgoing: list[bytes] = []
        self._texts = TextGate()
        self.commands: dict[int, Callable[[Command], int]] = {}  # MAV_CMD -> handler; it answers a MAV_RESULT

    # what others ask

    @property
    def system(self) -> int:
        return self._system or self._config.mavlink.system_id or 1

    @property
    def streams(self) -> bool:
        """Whether setpoints go out in this state."""
        state = self.situation.state
        if self._config.mode == "monitor" or self._system is None:
            return False
        return state in FLYING or (state is State.READY and self._profile.streams_when_ready)

    @property
    def text_counts(self) -> Counter[str]:
        """STATUSTEXTs that were repeated or dropped."""
        return self._texts.counts

    def retune(self, config: Config) -> None:
        """Time-outs of ``config`` from now on."""
        self._config = config

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
            self._sequence_ns = None
            self._hold_wanted = False
            if not self.situation.airborne:
                self.situation = replace(self.situation, reason="engaged, waiting to be airborne")
        return why

    def release(self, now_ns: int) -> None:
        self._event(Event.RELEASE)
        self._requested_ns = None
        self._run_requests(now_ns)

    def degraded(self, reason: str | None) -> None:
        """Tell whether the brain's inputs allow flying to the target (None) or only holding."""
        if (reason is not None) != self.situation.degraded:
            self._event(Event.RECOVERED if reason is None else Event.DEGRADED, reason or "")

    def fail(self, reason: str, now_ns: int) -> None:
        """The brain could not answer. Only a vehicle that we were flying is put into its hold mode, and once."""
        self._hold_wanted = self._hold_wanted or self.situation.state in FLYING
        self._event(Event.BRAIN_FAILED, reason)
        self._requested_ns = None
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
        self._asked_ns.clear()
        self._heard_ns.clear()
        self._attitude = None

    # what comes in

    def handle(self, event: LinkEvent, now_ns: int) -> VehicleState | None:
        """Take one MAVLink event; the vehicle state it completes, if it does."""
        match event:
            case Heartbeat():
                self._on_heartbeat(event, now_ns)
            case Attitude() if self._by_mavlink and self._is_ours(event):
                self._heard_ns[mav.MSG_ATTITUDE_QUATERNION] = now_ns
                self._attitude = event
            case Position() if self._by_mavlink and self._is_ours(event):
                self._heard_ns[mav.MSG_LOCAL_POSITION_NED] = now_ns
                return self._on_position(event)
            case LandedState() if self._is_ours(event):
                self._heard_ns[mav.MSG_EXTENDED_SYS_STATE] = now_ns
                self._on_landed(event)
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
        self._run_sequence(now_ns)
        self._run_requests(now_ns)
        self._ask_intervals(now_ns)
        self._tell()
        self._outgoing += [self._codec.encode_statustext(*said) for said in self._texts.take(now_ns)]

    # details

    @property
    def _by_mavlink(self) -> bool:
        return self._config.vehicle.source == "mavlink"

    def _is_ours(self, event: Attitude | Position | LandedState | Heartbeat) -> bool:
        """From the autopilot that was latched: other components of its system speak for themselves."""
        return (event.system, event.component) == (self._system, self._component)

    def _event(self, event: Event, detail: str = "") -> None:
        self.situation = advance(self.situation, event, engage_by=self._config.engage_by, detail=detail)

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
        self.custom_mode = beat.custom_mode
        grounded_fault = self.situation.state is State.FAULT and now_ns - self._failed_ns >= FAULT_RETRY_NS
        if not beat.armed and (self.armed or grounded_fault):
            self._event(Event.DISARMED)
        self.armed = beat.armed
        self._on_mode(beat.custom_mode == self._profile.external.custom_mode, now_ns)

    def _on_mode(self, external: bool, now_ns: int) -> None:
        if not external:
            self._hold_wanted = False
        if external == self.situation.external:
            return
        asked_ns = self._asked_external_ns
        ours = asked_ns is not None and now_ns - asked_ns <= self._config.engage.timeout_s * NS_PER_S
        if external and ours and not self.situation.engaged:
            # released while the mode was on its way: it is nobody's switch, and not wanted any more
            self.situation = advance(self.situation, Event.EXTERNAL_ON, engage_by="command")
            self._hold_wanted = True
        else:
            self._event(Event.EXTERNAL_ON if external else Event.EXTERNAL_OFF)

    def _choose(self, now_ns: int) -> None:
        chosen = self._latch.choose(now_ns)
        if chosen is not None:
            self._system, self._component = chosen
            self._codec.system = self._system

    def _on_position(self, position: Position) -> VehicleState | None:
        if self._attitude is None:
            return None
        return VehicleState(
            position.stamp_ns, position.p_enu, position.v_enu, self._attitude.q_enu_from_flu, position.p_std_m
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
            target_enu = reposition_target(command)
        except CommandRefused as refused:
            return refused.result
        return mav.RESULT_ACCEPTED if self._on_target(target_enu) is None else mav.RESULT_DENIED

    @property
    def _timeout_ns(self) -> int:
        return int(self._config.mavlink.heartbeat_timeout_s * NS_PER_S)

    def _is_fresh(self, now_ns: int) -> bool:
        if self._heartbeat_ns is None or self._state_ns is None or self._system is None:
            return False
        stale_ns = int(self._config.vehicle.stale_s * NS_PER_S)
        return now_ns - self._heartbeat_ns <= self._timeout_ns and now_ns - self._state_ns <= stale_ns

    def _lost_reason(self, now_ns: int) -> str:
        """Why there is no fresh vehicle; without numbers that change, so that it is told once."""
        if self._system is None and self._config.mavlink.system_id is None and len(self._latch.systems) > 1:
            return f"autopilots {self._latch.systems} heard, set mavlink.system_id"
        if self._heartbeat_ns is None:
            return "no heartbeat"
        if now_ns - self._heartbeat_ns > self._timeout_ns:
            return "heartbeat lost"
        return "no vehicle state" if not self._is_fresh(now_ns) else "vehicle fresh"

    def _run_sequence(self, now_ns: int) -> None:
        """Engaged but not in the external mode: stream for a while, then ask for it, then give up."""
        s = self.situation
        if not (s.engaged and s.state is State.READY and s.airborne and not s.external):
            self._sequence_ns = None
            return
        if self._sequence_ns is None:
            self._sequence_ns, self._requested_ns = now_ns, None
        since_s = (now_ns - self._sequence_ns) / NS_PER_S
        if since_s >= self._config.engage.stream_s + self._config.engage.timeout_s:
            self._event(Event.ENGAGE_TIMEOUT)
            self.say(mav.SEVERITY_WARNING, "engage: autopilot did not enter its external mode")
        elif since_s >= self._config.engage.stream_s:
            self._asked_external_ns = now_ns
            self._request(self._profile.external, now_ns)

    def _run_requests(self, now_ns: int) -> None:
        """A release, or a fault in flight, asks for the hold mode until it is seen; what a pilot does then stands."""
        if self.situation.releasing or self._hold_wanted:
            self._request(self._profile.hold, now_ns)

    def _request(self, mode: ModeRequest, now_ns: int) -> None:
        if self._config.mode == "monitor":
            return
        if self._requested_ns is None or now_ns - self._requested_ns >= REPEAT_NS:
            self._requested_ns = now_ns
            self._outgoing.append(self._codec.encode_set_mode(mode))

    def _ask_intervals(self, now_ns: int) -> None:
        """SET_MESSAGE_INTERVAL for what does not arrive, until it does."""
        if self._system is None:
            return
        rate_hz = float(self._config.rate_hz)
        wanted = {mav.MSG_EXTENDED_SYS_STATE: EXTENDED_SYS_STATE_HZ}
        if self._by_mavlink:
            wanted |= {mav.MSG_LOCAL_POSITION_NED: rate_hz, mav.MSG_ATTITUDE_QUATERNION: rate_hz}
        for message, hz in wanted.items():
            asked_ns, heard_ns = self._asked_ns.get(message), self._heard_ns.get(message)
            arriving = heard_ns is not None and now_ns - heard_ns < INTERVAL_RETRY_NS
            if asked_ns is None or (not arriving and now_ns - asked_ns >= INTERVAL_RETRY_NS):
                self._asked_ns[message] = now_ns
                self._outgoing.append(self._codec.encode_set_message_interval(message, hz))

    def _tell(self) -> None:
        """STATUSTEXT when state or reason changed, once each."""
        now = (self.situation.state, self.situation.reason)
        if now != self._told:
            self._told = now
            state, reason = now
            self.say(_SEVERITY.get(state, mav.SEVERITY_INFO), f"companion {state.value}: {reason}")
