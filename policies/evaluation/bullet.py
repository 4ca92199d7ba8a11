"""The PyBullet Crazyflie of sim_bridge under acceleration setpoints, in this process and without wires.

Physics at 240 Hz, the simulator's own controller, one setpoint a control period of 0.05 s as in the paper's Table 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType

import numpy as np

from companion.types import NS_PER_S, Vec3, VehicleState, frozen
from policies.env import EnvConfig, FloatArray, closest_on_segment
from policies.evaluation.pointmass import STAY_RADIUS_M, STAY_S, Flights, time_optimal_s
from sim_bridge.controller import AccelerationSetpoint, Controller, PositionSetpoint
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.obstacles import Motion
from sim_bridge.physics import Start, World, control_steps

PHYSICS_HZ = 240
CONTROL_HZ = 20
PERIOD_S = 1.0 / CONTROL_HZ
SETTLE_S = 1.5  # in which the rotors come up and the vehicle hovers at its start
LIFT_M = 11.0  # of the training's arena, which reaches below the ground

Law = Callable[[VehicleState], Vec3]  # net acceleration for one control period [m/s^2]


class BulletVehicle:
    """One vehicle, hovering at its start when it is built; the obstacles' clock starts then."""

    def __init__(self, start_enu: Vec3, motions: Sequence[Motion] = (), radii_m: Sequence[float] = ()) -> None:
        x, y, z = start_enu.tolist()
        vehicle = Crazyflie()
        self.world = World([vehicle], motions, radii_m=radii_m, physics_hz=PHYSICS_HZ, starts=[Start((x, y, z))])
        self._controller = Controller(vehicle, PHYSICS_HZ)
        self._substeps = control_steps(PHYSICS_HZ, CONTROL_HZ)
        self._periods = 0
        hover = PositionSetpoint((x, y, z))
        for _ in range(round(SETTLE_S * PHYSICS_HZ)):
            self.world.step([self._controller.rpm(self.world.states[0], hover)])
        self.world.start_motions()
        self.world.reset_min_clearance()

    @property
    def state(self) -> VehicleState:
        """True position and velocity; stamp 0 is the start of the flight."""
        body = self.world.states[0]
        stamp_ns = self._periods * NS_PER_S // CONTROL_HZ
        return VehicleState(stamp_ns, frozen(np.array(body.p_enu)), frozen(np.array(body.v_enu)))

    def advance(self, a_enu: Vec3) -> None:
        """One control period under a net acceleration."""
        x, y, z = a_enu.tolist()
        setpoint = AccelerationSetpoint((x, y, z))
        for _ in range(self._substeps):
            self.world.step([self._controller.rpm(self.world.states[0], setpoint)])
        self._periods += 1

    def obstacles(self) -> tuple[FloatArray, FloatArray]:
        """True positions and velocities now, (M, 3) each."""
        world = self.world
        return (
            np.array(world.obstacle_positions(world.t_s)).reshape(-1, 3),
            np.array(world.obstacle_velocities(world.t_s)).reshape(-1, 3),
        )

    def __enter__(self) -> BulletVehicle:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.world.close()


@dataclass(slots=True)
class Arrival:
    """Reached: the path passes within ``threshold_m``, then stays within `STAY_RADIUS_M` for ``stay_s``."""

    target_enu: Vec3
    threshold_m: float
    stay_s: float = STAY_S
    passed_s: float | None = None  # of the first passage, whether the vehicle stayed or not
    arrived_s: float | None = None  # of the passage after which it stays; None again once it has left
    reached: bool = False
    _last: Vec3 | None = field(default=None)

    def note(self, t_s: float, p_enu: Vec3) -> None:
        """The position at the end of a control period."""
        before = p_enu if self._last is None else self._last
        closest_m, _ = closest_on_segment(before[None], p_enu[None], self.target_enu[None])
        passing = float(closest_m[0]) < self.threshold_m
        near = math.dist(p_enu, self.target_enu) <= STAY_RADIUS_M
        self._last = p_enu
        if passing and self.passed_s is None:
            self.passed_s = t_s
        if passing and self.arrived_s is None and (near or self.stay_s == 0.0):
            self.arrived_s = t_s
        elif not near and self.stay_s > 0.0:
            self.arrived_s = None
        self.reached = self.arrived_s is not None and t_s - self.arrived_s >= self.stay_s - 1e-9


def fly_bullet(
    reference: Callable[[Vec3, Vec3], Vec3],
    p_enu: FloatArray,
    target_enu: FloatArray,
    *,
    config: EnvConfig,
    a_max_m_s2: float,
    timeout_s: float = 20.0,
    on_flight: Callable[[], None] = lambda: None,
) -> Flights:
    """As `pointmass.fly`, from hover, on the PyBullet vehicle; the arena is lifted by `LIFT_M` off the ground.

    Args:
        p_enu, target_enu: starts and targets in the arena of the training, (N, 3) [m].
    """
    count = len(p_enu)
    time_s, speed_max, effort = np.full(count, np.nan), np.zeros(count), np.zeros(count)
    passed, left = np.zeros((2, count), dtype=np.bool_)
    lift = np.array([0.0, 0.0, LIFT_M])
    for i, (start, target) in enumerate(zip(p_enu + lift, target_enu + lift, strict=True)):
        arrival = Arrival(target, config.threshold_m)
        with BulletVehicle(start) as vehicle:
            for step in range(1, round(timeout_s / PERIOD_S) + 1):
                state = vehicle.state
                a_ref = np.clip(reference(state.v_enu, target - state.p_enu), -a_max_m_s2, a_max_m_s2)
                vehicle.advance(a_ref)
                effort[i] += float(a_ref @ a_ref) * PERIOD_S if arrival.arrived_s is None else 0.0
                after = vehicle.state
                arrival.note(step * PERIOD_S, after.p_enu)
                speed_max[i] = max(speed_max[i], math.hypot(*after.v_enu.tolist()))
                left[i] |= bool((np.abs(after.p_enu - lift) > config.arena_m).any())
                if arrival.reached:
                    time_s[i] = arrival.arrived_s
                    break
        passed[i] = arrival.passed_s is not None
        on_flight()
    bound_s = time_optimal_s(target_enu - p_enu, a_max_m_s2)
    return Flights(time_s, bound_s, passed, left, speed_max, effort)
