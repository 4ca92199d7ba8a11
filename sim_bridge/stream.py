"""Offboard's proof of life: the stream of external setpoints, how long it has run, and what it asks for."""

from __future__ import annotations

from sim_bridge.messages import NS_PER_S, LocalSetpoint, Reply, Severity, Text, Vec3
from sim_bridge.setpoints import VELOCITY_IGNORED, refusal

STREAM_GAP_NS = NS_PER_S // 2  # 2 Hz
STREAM_NS = 450_000_000  # half a second of stream, less one period of 20 Hz for jitter


class SetpointStream:
    """The external setpoints of one vehicle; ``last`` is the newest that can be flown."""

    def __init__(self) -> None:
        self.last: LocalSetpoint | None = None
        self._start_ns = 0
        self._last_ns: int | None = None
        self._refused_ns: int | None = None

    def take(self, setpoint: LocalSetpoint, t_ns: int) -> tuple[Reply, ...]:
        """Take a setpoint; one that cannot be flown is dropped whole, said once a second at most."""
        reason = refusal(setpoint)
        if reason:
            if self._refused_ns is not None and t_ns - self._refused_ns < NS_PER_S:
                return ()
            self._refused_ns = t_ns
            return (Text(Severity.WARNING, f"Setpoint refused: {reason}"),)
        if self._last_ns is None or t_ns - self._last_ns > STREAM_GAP_NS:
            self._start_ns = t_ns
        self._last_ns = t_ns
        self.last = setpoint
        return ()

    def proven(self, t_ns: int) -> bool:
        """At least 2 Hz for half a second, up to now."""
        last_ns = self._last_ns
        return last_ns is not None and t_ns - last_ns <= STREAM_GAP_NS and t_ns - self._start_ns >= STREAM_NS

    def lost(self, t_ns: int, timeout_s: float) -> bool:
        """No setpoint for longer than ``timeout_s``, or none ever."""
        return self._last_ns is None or t_ns - self._last_ns > timeout_s * NS_PER_S


def acceleration(setpoint: LocalSetpoint, v_enu: Vec3, *, gain_per_s: float) -> Vec3:
    """a, or with a velocity setpoint a + k (v_sp - v), k = MPC_XY_VEL_P_ACC; ENU [m/s^2]."""
    if setpoint.type_mask & VELOCITY_IGNORED:
        return setpoint.a_enu
    (ax, ay, az), (sx, sy, sz), (vx, vy, vz) = setpoint.a_enu, setpoint.v_enu, v_enu
    return (ax + gain_per_s * (sx - vx), ay + gain_per_s * (sy - vy), az + gain_per_s * (sz - vz))
