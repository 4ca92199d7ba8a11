"""Several vehicles in one world: contacts, clearance, momentum, sensors, and the flight's end."""

import math

import numpy as np
import pybullet
import pytest

from sim_bridge.controller import Controller, PositionSetpoint
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.errors import ScenarioError
from sim_bridge.flight import Flight
from sim_bridge.messages import Cmd, Command, LocalSetpoint
from sim_bridge.obstacles import Static
from sim_bridge.physics import Start, World
from sim_bridge.placement import resolve
from sim_bridge.scenario import parse_scenario
from sim_bridge.scenario_world import Physics

OFF = (0.0, 0.0, 0.0, 0.0)
NO_DRAG = Physics(rotor_drag=False)


def world(*starts, motions=(), vehicle=None, effects=NO_DRAG):
    model = Crazyflie() if vehicle is None else vehicle
    radii_m = [0.2] * len(motions)
    return World([model] * len(starts), motions, radii_m=radii_m, physics_hz=240, starts=starts, effects=effects)


def test_each_has_its_own_clearance():
    at = [Start((0.0, 0.0, 2.0)), Start((1.0, 0.0, 2.0)), Start((5.0, 0.0, 2.0))]
    with world(*at, motions=[Static((5.0, 0.7, 2.0))]) as w:
        assert w.clearances_m == pytest.approx((0.6, 0.6, 0.3))
        for _ in range(24):
            w.step([OFF, OFF, OFF])
        assert w.clearances_m[:2] == pytest.approx((0.6, 0.6))  # they fall side by side
        assert w.min_clearances_m == pytest.approx([0.6, 0.6, 0.3])


def test_a_vehicle_flies_the_same_beside_another_far_away():
    def fly(*starts):
        with world(*starts, effects=Physics()) as w:
            controllers = [Controller(w.vehicles[0], 240) for _ in starts]
            goal = PositionSetpoint((1.0, -1.0, 1.5), 0.4)
            for _ in range(480):
                w.step(
                    [c.rpm(s, goal) for c, s in zip(controllers, w.states, strict=True)][:1] + [OFF] * len(starts[1:])
                )
            return w.states[0]

    start = Start((0.0, 0.0, 0.2), 0.3)
    assert fly(start) == fly(start, Start((50.0, 0.0, 0.2)))


@pytest.mark.parametrize("closing_m_s", [0.5, 3.0])
def test_a_collision_is_seen_and_conserves_momentum(closing_m_s):
    """No gravity: two vehicles thrown at each other exchange momentum and lose none."""
    vehicle = Crazyflie(g_m_s2=0.0)
    with world(Start((0.0, 0.0, 5.0)), Start((0.45, 0.0, 5.1)), vehicle=vehicle) as w:
        # thrown before the flight begins: a test may do what the flight never does
        pybullet.resetBaseVelocity(w.bodies[0].number, (closing_m_s, 0.0, 0.0), physicsClientId=w._client)
        w.step([OFF, OFF])
        before = np.sum([s.v_enu for s in w.states], axis=0)
        assert before == pytest.approx([closing_m_s, 0.0, 0.0], abs=1e-9)
        touched = False
        for _ in range(240):
            apart = w.states[1].v_enu == (0.0, 0.0, 0.0)
            w.step([OFF, OFF])
            assert apart or touched  # the other is not pushed before clearance has come to zero
            touched = touched or min(w.clearances_m) <= 0.0
        after = np.sum([s.v_enu for s in w.states], axis=0)
        assert after == pytest.approx(before, abs=1e-6)
        assert math.hypot(*w.states[1].v_enu) > 0.3 * closing_m_s
        energy = sum(np.dot(s.v_enu, s.v_enu) for s in w.states)
        assert energy <= closing_m_s**2 * (1.0 + 1e-6)


def test_bad_starts_are_refused_in_one_line():
    with pytest.raises(ScenarioError, match=r"^start: expected vehicles more than 0.4 m apart, got 0.3 m$"):
        world(Start((0.0, 0.0, 1.0)), Start((0.3, 0.0, 1.0)))
    with pytest.raises(ScenarioError, match=r"^starts: expected 1 values, one for each vehicle, got 0$"):
        World([Crazyflie()], (), radii_m=(), physics_hz=240, starts=())
    with pytest.raises(ScenarioError, match=r"^vehicles: expected at least one$"):
        World([], (), radii_m=(), physics_hz=240, starts=())


# --- flights

OPERATOR = (255, 190)


def flight(*vehicles, seed=0, **tables):
    raw = {"vehicles": list(vehicles), **tables}
    return Flight(resolve("two", parse_scenario(raw, source="two.toml"), seed))


def take_over(flight, index, a_enu=(0.0, 0.0, 0.0)):
    """Stream a setpoint and switch the vehicle, which starts in the air, to OFFBOARD."""
    craft = flight.crafts[index]
    for _ in range(14):
        craft.autopilot.setpoint(setpoint(flight, a_enu), flight.t_ns)
        period(flight)
    craft.autopilot.command(Command(Cmd.DO_SET_MODE, (1.0, 6.0, *[0.0] * 5), OPERATOR), craft.state, flight.t_ns)
    assert craft.autopilot.external


def setpoint(flight, a_enu):
    zero = (0.0, 0.0, 0.0)
    return LocalSetpoint(flight.t_ns // 1_000_000, 1, 0x0C3F, zero, zero, a_enu, 0.0, 0.0)


def period(flight):
    flight.control()
    for _ in range(flight.resolved.control_steps):
        flight.advance()


BOTH = ({"start": [0.0, 0.0, 1.5]}, {"start": [2.0, 0.0, 1.5], "yaw_deg": 90.0})


def test_each_craft_has_its_name_state_and_sensors():
    f = flight(*BOTH, sensors=[{"sigma_m": 0.0, "latency_s": 0.0, "dropout": 0.0}])
    try:
        assert [(c.name, c.system_id, c.prefix) for c in f.crafts] == [("uav1", 1, "uav/uav1"), ("uav2", 2, "uav/uav2")]
        period(f)
        for craft, other in (f.crafts, f.crafts[::-1]):
            assert craft.state is craft.truth
            seen = craft.frames("sim", f.t_ns)[0][1]
            assert [name for name, *_ in seen] == [other.name]
        assert f.crafts[0].frames("sim", f.t_ns) == []  # each frame is handed out once
    finally:
        f.close()


def test_sensors_of_two_vehicles_draw_different_noise():
    f = flight(*BOTH, obstacles=[{"motion": "static", "id": "post", "origin": [1.0, 5.0, 1.5]}])
    try:
        for _ in range(4):
            period(f)
        first, second = ([[s for s in seen if s[0] == "post"] for _, seen in c.frames("sim", f.t_ns)] for c in f.crafts)
        assert first != second
    finally:
        f.close()


def test_a_collision_of_vehicles_ends_the_flight_and_names_the_other():
    f = flight(*BOTH, target={"position": [2.0, 0.0, 1.5]})
    try:
        take_over(f, 0)
        for _ in range(200):
            f.crafts[0].autopilot.setpoint(setpoint(f, (2.0, 0.0, 0.0)), f.t_ns)
            period(f)
            if f.summary()["collided"]:
                break
        summary = f.summary()
        assert summary["collided"]
        assert summary["approaches"][0]["id"] == "uav2"
        assert [v["name"] for v in summary["vehicles"]] == ["uav1", "uav2"]
        assert summary["vehicles"][1]["collided"] is False  # it was never taken over, so it is not judged
        assert summary["vehicles"][0] == {"name": "uav1", "ended": None, **f.crafts[0].summary()}
        assert f.ended is None  # the other still has its target before it, until the time is up
        assert [v["name"] for v in f.trace_line()["vehicles"]] == ["uav1", "uav2"]
    finally:
        f.close()


def test_the_flight_ends_when_all_have_ended():
    f = flight(
        {"start": [0.0, 0.0, 1.5], "target": [0.0, 0.0, 1.5]},
        {"start": [2.0, 0.0, 1.5], "target": [2.0, 0.0, 1.5]},
        end={"hold_s": 0.5, "timeout_s": 5.0},
    )
    try:
        take_over(f, 0)
        ends = []
        for k in range(140):
            if k == 30:
                take_over(f, 1)
            for craft in f.crafts:
                craft.autopilot.setpoint(setpoint(f, (0.0, 0.0, 0.0)), f.t_ns)
            period(f)
            ends.append((f.crafts[0].ended, f.crafts[1].ended, f.ended))
        assert ("reached", None, None) in ends
        assert ends[-1] == ("reached", "reached", "reached")
    finally:
        f.close()


def test_parameters_of_the_scenario_reach_the_autopilot():
    f = flight({"parameters": {"COM_OF_LOSS_T": 0.5}}, {"start": [3.0, 0.0, 0.2]})
    try:
        assert [c.autopilot.parameters["COM_OF_LOSS_T"] for c in f.crafts] == [0.5, 1.0]
    finally:
        f.close()
    with pytest.raises(ScenarioError, match=r"uav1: parameters.COM_OBL_RC_ACT: expected a value in its range, got 4.5"):
        flight({"parameters": {"COM_OBL_RC_ACT": 4.5}}, {"start": [3.0, 0.0, 0.2]})
    with pytest.raises(ScenarioError, match=r"uav1: parameters: expected a parameter of px4, got NO_SUCH"):
        flight({"parameters": {"NO_SUCH": 1.0}}, {"start": [3.0, 0.0, 0.2]})
