"""Scenario files: what is refused and how it is said, and what a seed makes of one."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, get_args

import pytest

from sim_bridge.cli import main
from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import AWAY_ENU, Accelerated, Circle, FigureEight, Linear, Static, Timed
from sim_bridge.paths import Polyline, Spline
from sim_bridge.placement import describe, resolve
from sim_bridge.pursuit import Pursuit
from sim_bridge.scenario import Expectation, Obstacle, Scenario, load_scenario, parse_scenario, scenario_names
from sim_bridge.scenario_faults import What

LINEAR = {"id": "a", "motion": "linear", "cross_point": [1.0, 2.0, 3.0], "cross_at_s": 2.0, "velocity": [1.0, 0.0, 0.5]}
CIRCLE = {"id": "o", "motion": "circle", "origin": [0.0, 0.0, 2.0], "radius_path_m": 2.0, "period_s": 8.0}
WAY = {
    "id": "w",
    "motion": "waypoints",
    "points": [[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [2.0, 2.0, 1.0]],
    "speed_m_s": 1.0,
}
CURVE = {"id": "s", "motion": "spline", "points": WAY["points"], "times_s": [0.0, 2.0, 5.0]}
CHASE = {"id": "p", "motion": "pursuit", "origin": [5.0, 0.0, 1.0], "speed_m_s": 2.0, "accel_m_s2": 3.0}
FAULT = {"what": "drop", "on": "onboard", "at_s": 1.0}
TWO = [{"name": "a"}, {"name": "b"}]
EIGHT = {"id": "e", "motion": "figure_eight", "origin": [0.0, 0.0, 2.0], "size_m": 2.0, "period_s": 8.0}


def parsed(**changes: Any) -> Scenario:
    return parse_scenario(changes, source="test.toml")


@pytest.mark.parametrize("name", ["demo", "linear", "accelerated", "empty"])
def test_shipped_scenarios_resolve(name: str) -> None:
    stem, scenario = load_scenario(name)
    resolved = resolve(stem, scenario, 5)
    assert resolved.name == name
    assert len(resolved.obstacles) == len(scenario.obstacles)
    assert resolved.control_steps == 12
    assert resolved.period_ns == 50_000_000
    for obstacle in resolved.obstacles:
        # at the start nothing is near the vehicle, nothing is outside the arena
        p = obstacle.motion.position(0.0)
        assert all(abs(x) < 10.0 for x in p[:2])
        assert math.dist(p, (*scenario.vehicle.start[:2], scenario.vehicle.takeoff_altitude_m)) > 1.0


def test_every_shipped_scenario_says_what_it_is_and_what_must_be_seen() -> None:
    names = [name for name, path in scenario_names().items() if path.parent.name == "scenarios"]
    assert len(names) >= 25
    for name in names:
        stem, scenario = load_scenario(name)
        assert stem == name
        assert scenario.description
        assert scenario.expect != Expectation(), name
        assert scenario.end.timeout_s <= 15.0, name
        assert all(fault.expect is not None for fault in scenario.faults), name
        for obstacle in resolve(stem, scenario, 0).obstacles:
            p = obstacle.motion.position(0.0)
            # nothing touches a vehicle before it flies
            assert all(math.dist(p, v.start) > obstacle.radius_m + 0.3 for v in scenario.fleet), (name, obstacle.id)


def test_every_kind_of_motion_and_fault_is_shipped() -> None:
    scenarios = [load_scenario(name)[1] for name in scenario_names()]
    motions = {obstacle.__struct_config__.tag for scenario in scenarios for obstacle in scenario.obstacles}
    assert motions == {each.__struct_config__.tag for each in get_args(Obstacle)}
    whats = {fault.what for scenario in scenarios for fault in scenario.faults}
    assert set(get_args(What)) == whats
    assert {vehicle.personality for scenario in scenarios for vehicle in scenario.fleet} == {"px4", "ardupilot"}
    assert max(len(scenario.fleet) for scenario in scenarios) == 3


def test_the_demo_is_what_it_says() -> None:
    _, scenario = load_scenario("demo")
    resolved = resolve("demo", scenario, 0)
    assert scenario.target is not None
    assert 10.0 <= math.dist(scenario.vehicle.start[:2], scenario.target.position[:2]) <= 12.0
    motions = [o.motion for o in resolved.obstacles]
    assert len(motions) == 3
    assert all(isinstance(m, FigureEight) for m in motions)
    for motion, obstacle in zip(motions, scenario.obstacles, strict=True):
        assert obstacle.cross_at_s is not None
        fastest = max(math.hypot(*motion.velocity(0.05 * k)) for k in range(240))
        assert 1.2 <= fastest <= 1.8
        lowest = min(motion.position(0.05 * k)[2] for k in range(240))
        assert lowest - obstacle.radius_m > 0.3
    (sensor,) = scenario.sensors
    assert (sensor.sigma_m, sensor.latency_s, sensor.dropout, sensor.rate_hz) == (0.05, 0.05, 0.05, 20.0)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"typo": 1}, "typo"),
        ({"vehicle": {"typo": 1}}, "vehicle"),
        ({"physics_hz": 250}, "physics_hz"),
        ({"control_hz": 30, "physics_hz": 240}, "control_hz"),
        ({"physics_hz": 0}, "physics_hz"),
        ({"vehicle": {"start": [0.0, 0.0]}}, "vehicle.start"),
        ({"vehicle": {"start": [0.0, math.nan, 1.0]}}, "vehicle.start"),
        ({"vehicle": {"takeoff_altitude_m": 0.1}}, "vehicle.takeoff_altitude_m"),
        ({"target": {"position": [1e5, 0.0, 1.0]}}, "target.position"),
        ({"sensors": [{"dropout": 1.5}]}, "sensors[0].dropout"),
        ({"sensors": [{"rate_hz": 0.0}]}, "sensors[0].rate_hz"),
        ({"sensors": [{"source": "a/b"}]}, "sensors[0].source"),
        ({"sensors": [{}, {}]}, "sensors"),
        ({"obstacles": [{**LINEAR, "motion": "zigzag"}]}, "obstacles[0]"),
        ({"obstacles": [{**LINEAR, "radius_m": 0.0}]}, "obstacles[0].radius_m"),
        ({"obstacles": [LINEAR, LINEAR]}, "a twice"),
        ({"obstacles": [{**LINEAR, "origin": [0.0, 0.0, 0.0]}]}, "exactly one of origin and cross_point"),
        ({"obstacles": [{k: v for k, v in LINEAR.items() if k != "cross_at_s"}]}, "cross_at_s"),
        ({"obstacles": [{**EIGHT, "cross_at_s": 1.0}]}, "cross_at_s"),
        ({"obstacles": [{k: v for k, v in LINEAR.items() if k != "velocity"}]}, "velocity"),
        ({"operator": [{"do": "arm"}]}, "operator[0]"),
        ({"operator": [{"do": "arm", "at_tick": 1, "after": "airborne_hover"}]}, "operator[0]"),
        ({"operator": [{"do": "dance", "at_tick": 1}]}, "operator[0].do"),
        ({"end": {"timeout_s": -1.0}}, "end.timeout_s"),
        ({"vehicle": {}, "vehicles": [{}]}, "vehicles: expected [vehicle] or [[vehicles]]"),
        ({"vehicles": [{}, {"name": "uav1"}]}, "uav1 twice"),
        ({"vehicles": [{}, {"system_id": 1}]}, "system_id 1 twice"),
        ({"vehicles": [{"gcs_port": 5000}, {"onboard_port": 5000}]}, "port 5000 twice"),
        ({"vehicles": [{}, 3]}, "vehicles[1]"),
        ({"vehicle": {"system_id": 0}}, "vehicle.system_id"),
        ({"vehicle": {"personality": "betaflight"}}, "vehicle.personality: expected one of ardupilot, px4, got"),
        ({"vehicle": {"parameters": {"lower": 1}}}, "vehicle.parameters"),
        ({"vehicle": {"daemon": {"safety": {}}}}, "vehicle.daemon"),
        ({"vehicle": {"name": "a"}, "obstacles": [LINEAR]}, "a twice"),
        ({"obstacles": [{**CIRCLE, "period_s": 0.0}]}, "obstacles[0].period_s"),
        ({"obstacles": [{**WAY, "points": WAY["points"][:1]}]}, "obstacles[0].points"),
        ({"obstacles": [{**WAY, "points": [[0, 0, 1], [0, 0, 1]]}]}, "obstacles[0]: points: expected consecutive"),
        ({"obstacles": [{**CURVE, "times_s": [0.0, 1.0]}]}, "obstacles[0]: times_s: expected 3 times"),
        ({"obstacles": [{**CURVE, "times_s": [0.0, 1.0, 1.0]}]}, "obstacles[0]: times_s: expected rising"),
        ({"obstacles": [{**CHASE, "of": "uav9"}]}, "obstacles[0].of: expected one of uav1, got uav9"),
        ({"obstacles": [{**CHASE, "velocity": [3.0, 0.0, 0.0]}]}, "velocity: expected at most speed_m_s 2.0"),
        ({"obstacles": [{**LINEAR, "start_s": 2.0, "end_s": 2.0}]}, "end_s: expected later than start_s"),
        ({"sensors": [{"source": "world"}]}, "sensors[0]: source"),
        ({"sensors": [{"clutter": 1.0}]}, "sensors[0]: clutter: expected range_m or clutter_box"),
        ({"sensors": [{"fov_deg": 0.0}]}, "sensors[0].fov_deg"),
        ({"vehicles": TWO, "sensors": [{"vehicles": ["c"]}]}, "sensors[0].vehicles: expected one of a, b, got c"),
        ({"vehicles": TWO, "operator": [{"do": "arm", "at_tick": 0, "vehicle": "c"}]}, "operator[0].vehicle"),
        (
            {"physics": {"wind": {"gusts": "strong"}}},
            "physics.wind.gusts: expected one of light, moderate, none, severe",
        ),
        ({"physics": {"battery_start": 1.1}}, "physics.battery_start"),
        ({"faults": [{**FAULT, "what": "explode"}]}, "faults[0].what: expected one of"),
        ({"faults": [{**FAULT, "at_tick": 3}]}, "faults[0]: expected exactly one of at_s and at_tick"),
        ({"faults": [{**FAULT, "on": "lidar"}]}, "faults[0]: on: expected one of onboard, ground, obstacles, sim"),
        ({"faults": [{**FAULT, "what": "kill"}]}, "faults[0]: on: expected one of daemon, autopilot for kill"),
        ({"faults": [{**FAULT, "what": "kill", "on": "daemon", "for_s": 1.0}]}, "faults[0]: for_s"),
        ({"faults": [{**FAULT, "what": "cut", "share": 0.5}]}, "faults[0]: share"),
        ({"faults": [{**FAULT, "what": "delay"}]}, "faults[0]: value: expected a delay above 0 s"),
        ({"faults": [{**FAULT, "value": 1.0}]}, "faults[0]: value: expected none for drop"),
        ({"faults": [{**FAULT, "what": "gust", "on": "world", "value": 2.0}]}, "expected a wind [east, north, up]"),
        ({"faults": [{**FAULT, "what": "battery", "on": "autopilot", "value": 1.5}]}, "a state of charge, 0 to 1"),
        ({"faults": [{**FAULT, "what": "clock_jump", "on": "autopilot", "value": 1.1e6}]}, "a jump in s other than 0"),
        ({"faults": [{**FAULT, "expect": {"within_s": 1.0}}]}, "faults[0]: expect: expected state, verdict, mode or"),
        ({"faults": [{**FAULT, "vehicle": "b"}]}, "faults[0]: vehicle: expected one of uav1, got b"),
        ({"faults": [{**FAULT, "expect": {"state": "DONE"}}]}, "faults[0].expect.state: expected one of ACTIVE, FAULT"),
        ({"expect": {"never_state": ["NONE"]}}, "expect.never_state"),
        ({"expect": {"final_mode": "hold"}}, "expect.final_mode"),
    ],
)
def test_refusals_are_one_line_that_names_file_and_key(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ScenarioError) as refusal:
        parsed(**changes)
    text = str(refusal.value)
    assert text.startswith("test.toml: ")
    assert named in text
    assert "\n" not in text


def test_files_that_are_not_there_or_not_toml(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"one of accelerated, .*demo, .*empty, .*linear"):
        load_scenario("no-such")
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_scenario(str(tmp_path / "none.toml"))
    bad = tmp_path / "bad.toml"
    bad.write_text("x = ")
    with pytest.raises(ScenarioError, match=r"bad\.toml: not TOML"):
        load_scenario(str(bad))


def test_every_motion_passes_its_crossing_point_in_time() -> None:
    crossing = {"cross_point": [1.0, 2.0, 3.0], "cross_at_s": 2.0}
    eight = {k: v for k, v in EIGHT.items() if k != "origin"} | crossing
    scenario = parsed(
        obstacles=[
            LINEAR,
            {"id": "b", "motion": "accelerated", "velocity": [1, 0, 0], "acceleration": [0, -1, 0.25], **crossing},
            {**eight, "id": "c", "tilt_deg": 30.0},
            {**eight, "id": "d", "cross_phase_deg": 90.0},
            {"id": "f", "motion": "static", **crossing},
        ]
    )
    motions = [o.motion for o in resolve("x", scenario, 0).obstacles]
    assert [type(m) for m in motions] == [Linear, Accelerated, FigureEight, FigureEight, Static]
    for motion in motions:
        assert motion.position(2.0) == pytest.approx((1.0, 2.0, 3.0), abs=1e-12)
    assert isinstance(motions[2], FigureEight)
    assert motions[2].center_enu == pytest.approx((1.0, 2.0, 3.0))  # crosses at its centre
    assert isinstance(motions[3], FigureEight)
    assert motions[3].center_enu != pytest.approx((1.0, 2.0, 3.0), abs=0.5)


def test_jitter_stays_within_its_bounds_and_belongs_to_the_seed() -> None:
    jitter = {"position_m": [0.5, 0.0, 0.1], "time_s": 0.2, "yaw_deg": 30.0}
    scenario = parsed(obstacles=[{**LINEAR, "jitter": jitter}, {**LINEAR, "id": "b"}])
    headings, xs = [], []
    for seed in range(300):
        moving, fixed = (o.motion for o in resolve("x", scenario, seed).obstacles)
        assert isinstance(moving, Linear)
        assert fixed == Linear((-1.0, 2.0, 2.0), (1.0, 0.0, 0.5))
        assert resolve("x", scenario, seed).obstacles[0].motion == moving
        vx, vy, vz = moving.v_enu
        assert math.hypot(vx, vy) == pytest.approx(1.0)
        assert vz == 0.5
        headings.append(math.degrees(math.atan2(vy, vx)))
        # the time at which y = 2 is where the crossing point is passed, whatever the heading
        z_shift = moving.p0_enu[2] - 2.0
        assert abs(z_shift) <= 0.1 + 0.2 * 0.5 + 1e-9
        xs.append(moving.position(2.0)[0])
    assert -30.0 <= min(headings) < -25.0
    assert 25.0 < max(headings) <= 30.0
    assert max(abs(x - 1.0) for x in xs) <= 0.7 + 1e-9
    assert max(abs(x - 1.0) for x in xs) > 0.5


def test_every_new_motion_passes_its_crossing_point_in_time(tmp_path: Path) -> None:
    (tmp_path / "flown.csv").write_text("t_s,x,y,z\n0,0,0,1\n3,3,0,1\n5,3,4,1\n")
    crossing = {"cross_point": [1.0, 2.0, 3.0], "cross_at_s": 2.5, "jitter": {"yaw_deg": 40.0}}
    circle = {k: v for k, v in CIRCLE.items() if k != "origin"} | crossing
    track = {"motion": "track", "file": "flown.csv", **crossing}
    scenario = parse_scenario(
        {
            "obstacles": [
                {**circle, "cross_phase_deg": 30.0, "tilt_deg": 50.0},
                {**circle, "id": "c", "clockwise": True},
                {**WAY, **crossing},
                {**CURVE, **crossing},
                {**track, "id": "t1"},
                {**track, "id": "t2", "interpolation": "cubic", "start_s": 1.0},
            ]
        },
        source=str(tmp_path / "file.toml"),
    )
    for seed in range(5):
        motions = [o.motion for o in resolve("x", scenario, seed).obstacles]
        assert [type(m) for m in motions] == [Circle, Circle, Polyline, Spline, Polyline, Timed]
        for motion in motions:
            assert motion.position(2.5) == pytest.approx((1.0, 2.0, 3.0), abs=1e-12)
    assert motions[5].position(0.9) == AWAY_ENU


def test_paths_stand_where_they_are_written_or_shifted_by_their_origin() -> None:
    scenario = parsed(
        obstacles=[
            WAY,
            {**WAY, "id": "o", "origin": [10.0, 0.0, 0.5]},
            {**WAY, "id": "j", "jitter": {"yaw_deg": 90.0}},
        ]
    )
    written, shifted, turned = (o.motion for o in resolve("x", scenario, 3).obstacles)
    assert written.position(1.0) == (1.0, 0.0, 1.0)
    assert shifted.position(1.0) == (11.0, 0.0, 1.5)
    assert turned.position(0.0) == pytest.approx((0.0, 0.0, 1.0))  # it turns about its first point
    x, y, z = turned.position(1.0)
    assert math.hypot(x, y) == pytest.approx(1.0)
    assert abs(y) > 0.05
    assert z == 1.0


def test_a_late_obstacle_appears_a_drawn_time_earlier_or_later() -> None:
    scenario = parsed(obstacles=[{**EIGHT, "start_s": 2.0, "end_s": 9.0, "jitter": {"time_s": 0.5}}])
    starts = []
    for seed in range(50):
        (obstacle,) = resolve("x", scenario, seed).obstacles
        assert isinstance(obstacle.motion, Timed)
        starts.append(obstacle.motion.start_s)
        assert obstacle.motion.end_s == 9.0
    assert 1.5 <= min(starts) < 1.7
    assert 2.3 < max(starts) <= 2.5


def test_a_pursuit_is_of_the_vehicle_that_it_names() -> None:
    scenario = parsed(vehicles=TWO, obstacles=[CHASE, {**CHASE, "id": "q", "of": "b", "start_s": 1.0}])
    first, second = (o.motion for o in resolve("x", scenario, 0).obstacles)
    assert isinstance(first, Pursuit)
    assert isinstance(second, Pursuit)
    assert (first.target, second.target) == (0, 1)
    assert first.position(0.0) == (5.0, 0.0, 1.0)
    assert second.position(0.0) == AWAY_ENU


def test_a_fleet_is_numbered_and_the_vehicle_is_its_first() -> None:
    scenario = parsed(
        vehicles=[{"start": [1, 0, 0.2]}, {"target": [0, 0, 2]}, {"name": "x", "system_id": 9}],
        target={"position": [5, 0, 1]},
        sensors=[{"source": "s"}, {"source": "t", "vehicles": ["uav2", "x"]}],
    )
    assert [(v.name, v.system_id) for v in scenario.fleet] == [("uav1", 1), ("uav2", 2), ("x", 9)]
    assert scenario.vehicle == scenario.fleet[0]
    assert [scenario.target_of(v) for v in scenario.fleet] == [(5, 0, 1), (0, 0, 2), (5, 0, 1)]
    assert [[s.source for _, s in scenario.carried(v.name)] for v in scenario.fleet] == [["s"], ["s", "t"], ["s", "t"]]
    assert [i for i, _ in scenario.carried("x")] == [0, 1]
    assert parsed().fleet == (parsed().vehicle,)
    told = describe(resolve("x", scenario, 0), "uav1")["fleet"]
    assert [one["prefix"] for one in told] == ["uav/uav1", "uav/uav2", "uav/x"]
    assert told[1]["sources"] == ["s", "t"]


def test_each_vehicle_has_its_own_draws() -> None:
    resolved = resolve("x", parsed(vehicles=TWO), 4)
    first, second = resolved.sensor_rng(0, 0), resolved.sensor_rng(0, 1)
    assert first.random() == resolved.sensor_rng(0).random()  # as where there is one
    assert resolved.sensor_rng(0).random() != second.random()


def test_without_obstacles_and_description() -> None:
    _, scenario = load_scenario("demo")
    assert resolve("demo", scenario, 1, obstacles=False).obstacles == ()
    told = describe(resolve("demo", scenario, 1), "uav7")
    assert told["prefix"] == "uav/uav7"
    assert told["target"] == (6.5, 0.0, 1.5)
    assert told["sources"] == ["sim"]
    assert [step["do"] for step in told["operator"]] == ["arm", "takeoff", "engage"]
    assert told["obstacles"] != describe(resolve("demo", scenario, 2), "uav7")["obstacles"]


def test_sensor_draws_do_not_depend_on_the_obstacles() -> None:
    _, scenario = load_scenario("demo")
    with_them, without = (resolve("demo", scenario, 4, obstacles=o) for o in (True, False))
    assert with_them.sensor_rng(0).random() == without.sensor_rng(0).random()
    assert with_them.sensor_rng(0).random() != with_them.sensor_rng(1).random()


def test_command_line_prints_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenario", "linear", "--seed", "3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["seed"] == 3
    assert told["obstacles"][0]["motion"] == "Linear"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["run", "--scenario", "no-such"], "no-such"),
        (["run", "--lockstep", "--zenoh-listen", "none"], "--zenoh-listen"),
        (["run", "--onboard-port", "4000", "--gcs-port", "4000"], "4000"),
        (["run", "--scenario", "empty", "--zenoh-listen", "none", "--trace", "/no/such/place"], "/no/such/place"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(
    arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert named in told.err


@pytest.mark.parametrize("arguments", [["run", "--seed", "-1"], ["run", "--gcs-port", "0"], []])
def test_argparse_refuses_with_status_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(arguments)
    assert done.value.code == 2
