"""The conversation with the autopilot and the operator: MAVLink events in, state machine events and replies out.

Sans-I/O: time is an argument, bytes to send collect in ``take_outgoing``. ``now_ns`` is vehicle time in lockstep and
the monotonic clock otherwise; only differences of it are used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from companion.config import Config
from companion.link import mav
from companion.link.decode import CommandRefused, reposition_target
from companion.link.events import Attitude, Command, Heartbeat, LandedState, Position
from companion.link.events import Event as LinkEvent
from companion.link.mavlink import MavlinkCodec
from companion.profiles import ModeRequest
from companion.state import FLYING, Event, Situation, State, advance, refusal
from companion.types import NS_PER_S, Vec3, VehicleState

LATCH_NS = 3 * NS_PER_S  # exactly one autopilot heard for this long is ours
REPEAT_NS = NS_PER_S // 2  # mode requests
INTERVAL_RETRY_NS = 2 * NS_PER_S
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
        self._stamp_ns = 0  # of the newest vehicle state
        self._attitude: Attitude | None = None
        self._system: int | None = None
        self._candidates: dict[int, int] = {}  # system -> first heard
        self._heartbeat_ns: int | None = None
        self._state_ns: int | None = None
        self._sequence_ns: int | None = None  # start of the engage sequence
        self._requested_ns: int | None = None  # last mode request
        self._intervals_ns: int | None = None
        self._told: tuple[State, str] | None = None
        self._outgoing: list[bytes] = []

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
        return why

    def release(self, now_ns: int) -> None:
        self._event(Event.RELEASE)
        self._requested_ns = None
        self._run_requests(now_ns)

    def degraded(self, reason: str | None) -> None:
        """Tell whether the brain's inputs allow flying to the target (None) or only holding."""
        if (reason is not None) != self.situation.degraded:
            self._event(Event.RECOVERED if reason is None else Event.DEGRADED, reason or "")

    def fail(self, reason: str) -> None:
        """The brain could not answer."""
        self._event(Event.BRAIN_FAILED, reason)
        self._requested_ns = None

    # what comes in

    def handle(self, event: LinkEvent, now_ns: int) -> VehicleState | None:
        """Take one MAVLink event; the vehicle state it completes, if it does."""
        match event:
            case Heartbeat():
                self._on_heartbeat(event, now_ns)
            case Attitude() if self._is_ours(event.system):
                self._attitude = event
            case Position() if self._is_ours(event.system):
                return self._on_position(event)
            case LandedState() if self._is_ours(event.system):
                self._on_landed(event)
            case Command():
                self._on_command(event, now_ns)
            case _:
                pass
        return None

    def heard_vehicle(self, vehicle: VehicleState, now_ns: int) -> None:
        """A vehicle state arrived, from MAVLink or Zenoh."""
        if vehicle.stamp_ns < self._stamp_ns - NS_PER_S:
            self._intervals_ns = None  # the boot clock went back: a reboot forgets message intervals
        self._stamp_ns = vehicle.stamp_ns
        self._state_ns = now_ns

    def poll(self, now_ns: int) -> None:
        """Time passes: freshness, latching, the engage, release and fault sequences, message intervals, STATUSTEXT."""
        self._latch(now_ns)
        fresh = self._is_fresh(now_ns)
        if fresh != self.situation.fresh:
            self._event(Event.VEHICLE_FRESH if fresh else Event.VEHICLE_LOST, self._lost_reason(now_ns))
        elif self.situation.state is State.WAITING:
            self.situation = replace(self.situation, reason=self._lost_reason(now_ns))
        self._run_sequence(now_ns)
        self._run_requests(now_ns)
        self._ask_intervals(now_ns)
        self._tell()

    # details

    def _is_ours(self, system: int) -> bool:
        return self._config.vehicle.source == "mavlink" and system == self._system

    def _event(self, event: Event, detail: str = "") -> None:
        self.situation = advance(self.situation, event, engage_by=self._config.engage_by, detail=detail)

    def _on_heartbeat(self, beat: Heartbeat, now_ns: int) -> None:
        if beat.autopilot == mav.AUTOPILOT_INVALID:
            return
        wanted = self._config.mavlink.system_id
        if self._system is None:
            self._candidates.setdefault(beat.system, now_ns)
            if wanted is not None and beat.system == wanted:
                self._take_system(wanted)
        if beat.system != self._system:
            return
        if self._heartbeat_ns is not None and now_ns - self._heartbeat_ns > self._timeout_ns:
            self._intervals_ns = None  # it may have rebooted: message intervals are lost then
        self._heartbeat_ns = now_ns
        external = beat.custom_mode == self._profile.external.custom_mode
        self.custom_mode = beat.custom_mode
        if self.armed and not beat.armed:
            self._event(Event.DISARMED)
        self.armed = beat.armed
        if external != self.situation.external:
            self._event(Event.EXTERNAL_ON if external else Event.EXTERNAL_OFF)

    def _take_system(self, system: int) -> None:
        self._system = system
        self._codec.system = system

    def _latch(self, now_ns: int) -> None:
        if self._system is not None or self._config.mavlink.system_id is not None or len(self._candidates) != 1:
            return
        [(system, first_ns)] = self._candidates.items()
        if now_ns - first_ns >= LATCH_NS:
            self._take_system(system)

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
        if self._system is None and len(self._candidates) > 1:
            return f"autopilots {sorted(self._candidates)} heard, set mavlink.system_id"
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
            self._status(mav.SEVERITY_WARNING, "engage: autopilot did not enter its external mode")
        elif since_s >= self._config.engage.stream_s:
            self._request(self._profile.external, now_ns)

    def _run_requests(self, now_ns: int) -> None:
        """A release, or a fault while the autopilot still obeys us, asks for the hold mode until it is seen."""
        s = self.situation
        if s.releasing or (s.state is State.FAULT and s.external):
            self._request(self._profile.hold, now_ns)

    def _request(self, mode: ModeRequest, now_ns: int) -> None:
        if self._config.mode == "monitor":
            return
        if self._requested_ns is None or now_ns - self._requested_ns >= REPEAT_NS:
            self._requested_ns = now_ns
            self._outgoing.append(self._codec.encode_set_mode(mode))

    def _ask_intervals(self, now_ns: int) -> None:
        if self._system is None or self._config.vehicle.source != "mavlink":
            return
        answered = self._intervals_ns is not None and self.situation.fresh
        if answered or (self._intervals_ns is not None and now_ns - self._intervals_ns < INTERVAL_RETRY_NS):
            return
        self._intervals_ns = now_ns
        rate_hz = float(self._config.rate_hz)
        for message, hz in (
            (mav.MSG_LOCAL_POSITION_NED, rate_hz),
            (mav.MSG_ATTITUDE_QUATERNION, rate_hz),
            (mav.MSG_EXTENDED_SYS_STATE, EXTENDED_SYS_STATE_HZ),
        ):
            self._outgoing.append(self._codec.encode_set_message_interval(message, hz))

    def _tell(self) -> None:
        """STATUSTEXT when state or reason changed, once each."""
        now = (self.situation.state, self.situation.reason)
        if now != self._told:
            self._told = now
            state, reason = now
            self._status(_SEVERITY.get(state, mav.SEVERITY_INFO), f"companion {state.value}: {reason}")

    def _status(self, severity: int, text: str) -> None:
        self._outgoing.append(self._codec.encode_statustext(severity, text))
