"""The air around the vehicles: before each physics step it tells every body its wind, thrust factors and downwash."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sim_bridge.body import Body
from sim_bridge.crazyflie import Triple
from sim_bridge.effects import downwash_n, ground_factors
from sim_bridge.errors import ScenarioError
from sim_bridge.scenario_world import Physics
from sim_bridge.wind import Wind


class Air:
    """What of ``effects`` comes from the air.

    Args:
        rngs: one generator per body, for its gusts; none needed without.
    Raises:
        ScenarioError: wind that has nothing to act through, or gusts without generators.
    """

    def __init__(
        self, effects: Physics, bodies: Sequence[Body], *, physics_hz: int, rngs: Sequence[np.random.Generator]
    ) -> None:
        gusty = effects.wind.gusts != "none"
        if gusty and len(rngs) != len(bodies):
            raise ScenarioError(f"physics.wind.gusts: expected {len(bodies)} generators, got {len(rngs)}")
        self._bodies = tuple(bodies)
        self._ground, self._downwash = effects.ground_effect, effects.downwash and len(bodies) > 1
        self._drag = effects.rotor_drag
        self._wind = Wind(effects.wind.steady, effects.wind.gusts, dt_s=1.0 / physics_hz, rngs=tuple(rngs))
        self.stirred = self._ground or self._downwash or not self._wind.still  # `stir` has something to do
        if not self._wind.still:
            self._need_drag("physics.wind")

    def gust(self, v_enu: Triple, until_s: float) -> None:
        """Add a wind of ``v_enu`` everywhere until ``until_s`` of the world's time."""
        self._need_drag("gust")
        self._wind.gust(v_enu, until_s)
        self.stirred = True

    def stir(self, t_s: float) -> None:
        """Set what acts on the bodies in the step that begins at ``t_s``."""
        self._wind.forget(t_s)
        for index, body in enumerate(self._bodies):
            state = body.state
            body.wind_enu = self._wind.at(index, state.v_enu, state.p_enu[2])
            if self._ground:
                body.factors = ground_factors(state.p_enu, state.q_wxyz, body.rotors_flu)
            if self._downwash:
                body.downwash_n = sum(self._wake(above, body) for above in self._bodies if above is not body)

    @staticmethod
    def _wake(above: Body, body: Body) -> float:
        (x, y, z), (xa, ya, za) = body.state.p_enu, above.state.p_enu
        aside_m = math.hypot(xa - x, ya - y)
        return downwash_n(za - z, aside_m, thrust_n=sum(above.thrusts_n), weight_n=above.vehicle.weight_n)

    def _need_drag(self, key: str) -> None:
        if not self._drag:
            raise ScenarioError(f"{key}: expected physics.rotor_drag = true, through which wind acts")
