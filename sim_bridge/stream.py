"""Offboard's proof of life: the stream of external setpoints, how long it has run, and what it asks for."""

from __future__ import annotations

from sim_bridge.messages import NS_PER_S, AttitudeTarget, LocalSetpoint, Reply, Severity, Text
from sim_bridge.physics import BodyState
from sim_bridge.px4.position import Trajectory
from sim_bridge.setpoints import attitude_refusal, refusal, trajectory

STREAM_GAP_NS = NS_PER_S // 2  # 2 Hz
STREAM_NS = 450_000_000  # half a second of stream, less one period of 20 Hz for jitter


class SetpointStream:
    """The external setpoints of one vehicle; ``last`` is the newest that can be flown, ``wanted`` what it means."""

    def __init__(self) -> None:
        self.last: LocalSetpoint | AttitudeTarget | None = None
        self.wanted: Trajectory | AttitudeTarget | None = None
        self._start_ns = 0
        self._last_ns: int | None = None
        self._refused_ns: int | None = None

    def take(self, setpoint: LocalSetpoint, state: BodyState, home_z_m: float, t_ns: int) -> tuple[Reply, ...]:
        """Take a setpoint; one that cannot be flown is dropped whole, said once a second at most."""
        reason = refusal(setpoint)
        if reason:
            return self._refuse(reason, t_ns)
        self._count(t_ns)
        self.last, self.wanted = setpoint, trajectory(setpoint, state, home_z_m)
        return ()

    def take_attitude(self, setpoint: AttitudeTarget, t_ns: int) -> tuple[Reply, ...]:
        """Take an attitude or rate setpoint, as `take` does."""
        reason = attitude_refusal(setpoint)
        if reason:
            return self._refuse(reason, t_ns)
        self._count(t_ns)
        self.last = self.wanted = setpoint
        return ()

    def proven(self, t_ns: int) -> bool:
        """At least 2 Hz for half a second, up to now."""
        last_ns = self._last_ns
        return last_ns is not None and t_ns - last_ns <= STREAM_GAP_NS and t_ns - self._start_ns >= STREAM_NS

    def lost(self, t_ns: int, timeout_s: float) -> bool:
        """No setpoint for longer than ``timeout_s``, or none ever."""
        return self._last_ns is None or t_ns - self._last_ns > timeout_s * NS_PER_S

    def _count(self, t_ns: int) -> None:
        if self._last_ns is None or t_ns - self._last_ns > STREAM_GAP_NS:
            self._start_ns = t_ns
        self._last_ns = t_ns

    def _refuse(self, reason: str, t_ns: int) -> tuple[Reply, ...]:
        if self._refused_ns is not None and t_ns - self._refused_ns < NS_PER_S:
            return ()
        self._refused_ns = t_ns
        return (Text(Severity.WARNING, f"Setpoint refused: {reason}"),)
