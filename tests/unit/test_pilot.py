"""The brain in one call: order, delay, tasks, determinism."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import pytest

from companion.config import Config, parse_config
from companion.errors import BrainFailure, PolicyOutputInvalid
from companion.pilot import Pilot, PilotInput, PilotOutput, Task
from companion.policy import artifact_folder
from companion.types import (
    Detection,
    DetectionFrame,
    DetectionKind,
    FloatArray,
    Vec3,
    VehicleState,
    Verdict,
    frozen,
)

TICK_NS = 50_000_000


class Straight:
    """A policy that always wants the same acceleration; ``broken`` makes its output invalid."""

    def __init__(self, a: list[float]) -> None:
        self.a = np.array(a)
        self.broken = False
        self.asked: list[tuple[Vec3, Vec3]] = []

    def act(self, v_enu: Vec3, error_enu: Vec3) -> FloatArray:
        self.asked.append((v_enu, error_enu))
        if self.broken:
            raise PolicyOutputInvalid("nan")
        return self.a


def pilot(policy: Any, **sections: dict[str, Any]) -> Pilot:
    return Pilot(parse_config({"disturbance": {"enabled": False}, **sections}), policy)


def vehicle(k: int, p: list[float], v: list[float] = [0, 0, 0]) -> VehicleState:  # noqa: B006 - never written to
    return VehicleState(k * TICK_NS, frozen(p), frozen(v))


def ball(k: int, p: list[float]) -> DetectionFrame:
    seen = Detection("ball", frozen(p), 0.2, p_std_m=0.05)
    return DetectionFrame(k * TICK_NS, "radar", k, DetectionKind.DETECTION, (seen,))


def fly(brain: Pilot, ticks: int, **options: Any) -> list[PilotOutput]:
    """A vehicle that does as it is told, towards a ball in its way."""
    outputs = []
    p, v = np.array([0.0, 0.0, 2.0]), np.zeros(3)
    for k in range(ticks):
        inputs = PilotInput(
            vehicle(k, p.tolist(), v.tolist()), (ball(k, [6.0, 0.02, 2.0]),), Task.FLY, frozen([9, 0, 2])
        )
        outputs.append(brain.step(inputs, **options))
        p = p + v * 0.05
        v = v + outputs[-1].wire * 0.05
    return outputs


def test_an_obstacle_in_the_way_is_avoided_and_the_verdict_says_so() -> None:
    outputs = fly(pilot(Straight([2.0, 0.0, 0.0])), 60)
    verdicts = {output.result.verdict for output in outputs}
    assert outputs[0].result.verdict is Verdict.NOMINAL
    assert Verdict.ADJUSTED in verdicts
    first = next(output for output in outputs if output.result.verdict is Verdict.ADJUSTED)
    assert first.result.worst is not None
    assert first.result.worst.track == "radar/ball"
    assert not np.array_equal(first.result.a_safe, first.u_ref)


def test_a_nominal_answer_is_the_reference_to_the_bit() -> None:
    for output in fly(pilot(Straight([0.1, 0.2, 0.3])), 10):
        assert output.result.verdict is Verdict.NOMINAL
        assert output.result.a_safe.tobytes() == np.array([0.1, 0.2, 0.3]).tobytes()
        assert output.wire.tobytes() == output.result.a_safe.tobytes()


def test_reset_repeats_the_flight_to_the_bit() -> None:
    brain = pilot(Straight([2.0, 0.0, 0.0]))
    first = fly(brain, 50)
    brain.reset()
    for a, b in zip(first, fly(brain, 50), strict=True):
        assert a.wire.tobytes() == b.wire.tobytes()
        assert a.prediction.p_enu.tobytes() == b.prediction.p_enu.tobytes()
        assert a.result.verdict is b.result.verdict


def test_filter_none_passes_the_reference() -> None:
    for output in fly(pilot(Straight([2.0, 0.0, 0.0]), safety={"filter": "none"}), 60):
        np.testing.assert_array_equal(output.result.a_safe, [2.0, 0.0, 0.0])
        assert output.result.solver == "none"


def test_prediction_starts_when_the_setpoint_acts() -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]), delay={"loop_s": 0.02, "actuation_s": 0.08})
    output = brain.step(PilotInput(vehicle(4, [0, 0, 2]), (ball(4, [6, 0, 2]),)))
    assert output.prediction.start_ns == 4 * TICK_NS + 100_000_000
    assert output.prediction.p_enu.shape == (1, 23, 3)


def test_vehicle_is_predicted_under_the_commands_already_given() -> None:
    """Dead time of two ticks: the commands of the last two ticks are still to act, one after the other."""
    policy = Straight([1.0, 0.0, 0.0])
    brain = pilot(policy, delay={"loop_s": 0.0, "actuation_s": 0.1})
    p, v = np.array([0.0, 0.0, 2.0]), np.array([1.0, 0.0, 0.0])
    brain.step(PilotInput(vehicle(0, p.tolist(), v.tolist())))
    policy.a = np.array([3.0, 0.0, 0.0]) * 0.5
    brain.step(PilotInput(vehicle(1, [0.05, 0, 2], v.tolist())))
    p_act, v_act = brain._at_action(vehicle(2, [0.1, 0, 2], v.tolist()))
    # 1.0 m/s^2 for 0.05 s, then 1.5 m/s^2 for 0.05 s
    v1 = 1.0 + 1.0 * 0.05
    expected = 0.1 + 1.0 * 0.05 + 0.5 * 1.0 * 0.05**2 + v1 * 0.05 + 0.5 * 1.5 * 0.05**2
    np.testing.assert_allclose(p_act, [expected, 0, 2], atol=1e-12)
    np.testing.assert_allclose(v_act, [v1 + 1.5 * 0.05, 0, 0], atol=1e-12)


def test_before_the_first_command_the_vehicle_coasts() -> None:
    brain = pilot(Straight([1.0, 0.0, 0.0]), delay={"actuation_s": 0.1})
    p_act, v_act = brain._at_action(vehicle(0, [0, 0, 2], [2, 0, 0]))
    np.testing.assert_allclose(p_act, [0.2, 0, 2])
    np.testing.assert_allclose(v_act, [2, 0, 0])


def test_what_is_not_sent_is_not_commanded() -> None:
    brain = pilot(Straight([2.0, 0.0, 0.0]), delay={"actuation_s": 0.1})
    brain.step(PilotInput(vehicle(0, [0, 0, 2])), sent=False)
    _, v_act = brain._at_action(vehicle(1, [0, 0, 2], [0, 0, 0]))
    np.testing.assert_array_equal(v_act, [0, 0, 0])


def test_an_invalid_policy_brakes_and_says_so() -> None:
    policy = Straight([2.0, 0.0, 0.0])
    brain = pilot(policy)
    policy.broken = True
    output = brain.step(PilotInput(vehicle(0, [0, 0, 2], [1, 0, 0]), target_enu=frozen([5, 0, 2])))
    assert not output.policy_valid
    assert output.u_ref[0] < 0.0
    held = brain.step(PilotInput(vehicle(1, [0, 0, 2], [1, 0, 0]), task=Task.HOLD, target_enu=frozen([5, 0, 2])))
    assert not held.policy_valid
    policy.broken = False
    assert brain.step(
        PilotInput(vehicle(2, [0, 0, 2], [1, 0, 0]), task=Task.HOLD, target_enu=frozen([5, 0, 2]))
    ).policy_valid


def test_without_a_target_it_holds_where_it_was_engaged() -> None:
    policy = Straight([0.0, 0.0, 0.0])
    brain = pilot(policy)
    brain.step(PilotInput(vehicle(0, [1, 1, 2])))
    brain.step(PilotInput(vehicle(1, [1.5, 1, 2])))
    np.testing.assert_allclose(policy.asked[1][1], [-0.5, 0, 0])


def test_hold_brakes_then_anchors() -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]), delay={"actuation_s": 0.0})
    braking = brain.step(PilotInput(vehicle(0, [0, 0, 2], [2, 0, 0]), task=Task.HOLD))
    assert braking.u_ref[0] < -2.0
    brain.step(PilotInput(vehicle(1, [1, 0, 2], [0.1, 0, 0]), task=Task.HOLD))
    back = brain.step(PilotInput(vehicle(2, [1.5, 0, 2], [0, 0, 0]), task=Task.HOLD))
    assert back.u_ref[0] < 0.0  # drifted off the anchor at x = 1
    np.testing.assert_array_equal(back.u_ref[1:], [0, 0])


def test_stay_never_pulls_back() -> None:
    brain = pilot(Straight([2.0, 0.0, 0.0]))
    brain.step(PilotInput(vehicle(0, [0, 0, 0.2]), task=Task.STAY))
    output = brain.step(PilotInput(vehicle(1, [5, 0, 0.2]), task=Task.STAY))
    assert not output.u_ref.any()
    assert output.result.verdict is Verdict.NOMINAL  # floor and arena rows are off on the ground


@pytest.mark.parametrize("bad", [[np.nan, 0, 2], [0, np.inf, 2]])
def test_a_vehicle_state_that_is_not_finite_is_a_failure(bad: list[float]) -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]))
    with pytest.raises(BrainFailure, match="finite"):
        brain.step(PilotInput(vehicle(0, bad)))


def test_time_must_advance() -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]))
    brain.step(PilotInput(vehicle(5, [0, 0, 2])))
    with pytest.raises(BrainFailure, match="stamp"):
        brain.step(PilotInput(vehicle(5, [0, 0, 2])))


def test_the_reserve_for_the_disturbance_is_kept() -> None:
    config = parse_config({"disturbance": {"bound_m_s2": 0.4}})
    brain = Pilot(config, Straight([3.0, 3.0, -3.0]))  # type: ignore[arg-type]
    output = brain.step(PilotInput(vehicle(0, [0, 0, 5])))
    np.testing.assert_allclose(output.u_ref, [2.6, 2.6, -2.6])
    assert np.abs(output.wire).max() <= Config().limits.acceleration_m_s2


def test_a_constant_push_is_taken_off_the_wire() -> None:
    policy = Straight([0.0, 0.0, 0.0])
    brain = Pilot(parse_config({"delay": {"actuation_s": 0.0}}), policy)  # type: ignore[arg-type]
    v, wire = np.zeros(3), np.zeros(3)
    for k in range(200):
        output = brain.step(PilotInput(vehicle(k, [0, 0, 5], v.tolist())))
        wire = output.wire
        v = v + (wire + np.array([0.2, 0.0, -0.1])) * 0.05
    np.testing.assert_allclose(wire, [-0.2, 0.0, 0.1], atol=0.02)
    np.testing.assert_array_equal(output.result.a_safe, [0, 0, 0])


def test_observing_ahead_changes_nothing_to_the_bit() -> None:
    plain, ahead = pilot(Straight([2.0, 0.0, 0.0])), pilot(Straight([2.0, 0.0, 0.0]))
    p, v = np.array([0.0, 0.0, 2.0]), np.zeros(3)
    for k in range(60):
        frames = (ball(k, [6.0, 0.02 * k, 2.0]),)
        inputs = PilotInput(vehicle(k, p.tolist(), v.tolist()), frames, Task.FLY, frozen([9, 0, 2]))
        expected = plain.step(inputs)
        if k % 3:
            ahead.observe(frames, k * TICK_NS)
        output = ahead.step(inputs)
        assert output.wire.tobytes() == expected.wire.tobytes()
        assert output.prediction.p_enu.tobytes() == expected.prediction.p_enu.tobytes()
        assert ahead.tracks().covariance.tobytes() == plain.tracks().covariance.tobytes()
        p, v = p + v * 0.05, v + output.wire * 0.05


def test_observing_for_another_tick_is_not_used() -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]))
    brain.observe((), 7 * TICK_NS)
    output = brain.step(PilotInput(vehicle(8, [0, 0, 2]), (ball(8, [6, 0, 2]),)))
    assert output.prediction.ids == ("radar/ball",)
    assert output.prediction.start_ns >= 8 * TICK_NS


def own_sight(k: int, p: list[float], name: str | None) -> DetectionFrame:
    """The vehicle as its own sensor sees it, 0.1 m off."""
    seen = Detection(name, frozen([p[0] + 0.1 * (-1) ** k, p[1], p[2]]), 0.2, p_std_m=0.1)
    return DetectionFrame(k * TICK_NS, "cam", k, DetectionKind.DETECTION, (seen,))


@pytest.mark.parametrize("name", ["uav1", None])
def test_the_vehicle_reported_as_an_obstacle_does_not_disturb_its_flight(name: str | None) -> None:
    brain = pilot(Straight([1.0, 0.5, 0.0]))
    p, v = np.array([0.0, 0.0, 2.0]), np.zeros(3)
    for k in range(60):
        frames = (own_sight(k, p.tolist(), name),)
        output = brain.step(PilotInput(vehicle(k, p.tolist(), v.tolist()), frames, Task.FLY, frozen([9, 9, 2])))
        if k > 0:  # before the first tick nobody knows where the vehicle is
            assert output.result.verdict is Verdict.NOMINAL
            assert output.result.a_safe.tobytes() == output.u_ref.tobytes()
        p, v = p + v * 0.05, v + output.wire * 0.05
    assert brain.tracking_counts == {"own_vehicle": 59}
    brain.reset()
    assert brain.tracking_counts == {}


def test_the_own_vehicle_is_recognised_at_the_library_door_too() -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]))
    for k in range(5):
        result = brain.filter_acceleration(vehicle(k, [0, 0, 2]), frozen([0.5, 0, 0]), (own_sight(k, [0, 0, 2], "me"),))
    assert result.verdict is Verdict.NOMINAL
    assert brain.tracking_counts == {"own_vehicle": 4}


def test_observing_ahead_recognises_the_vehicle_to_the_same_bit() -> None:
    plain, ahead = pilot(Straight([1.0, 0.0, 0.0])), pilot(Straight([1.0, 0.0, 0.0]))
    for k in range(40):
        p = [0.02 * k, 0.0, 2.0]
        frames = (ball(k, [6.0, 0.02 * k, 2.0]), own_sight(k, p, None))
        inputs = PilotInput(vehicle(k, p, [0.4, 0, 0]), frames, Task.FLY, frozen([9, 0, 2]))
        expected = plain.step(inputs)
        ahead.observe(frames, k * TICK_NS)
        assert ahead.step(inputs).wire.tobytes() == expected.wire.tobytes()
        assert ahead.tracks().covariance.tobytes() == plain.tracks().covariance.tobytes()
    assert ahead.tracking_counts == plain.tracking_counts == {"own_vehicle": 39}


def reset_at(k: int, p: list[float], v: list[float], counter: int) -> VehicleState:
    return VehicleState(k * TICK_NS, frozen(p), frozen(v), reset_counter=counter)


def test_an_estimator_reset_forgets_the_origin_and_keeps_what_does_not_depend_on_it() -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]), disturbance={"enabled": True}, delay={"actuation_s": 0.1})
    x, v = 0.0, 0.0
    for k in range(60):  # a push of 0.2 m/s^2 that nobody commanded, and a ball
        output = brain.step(PilotInput(reset_at(k, [x, 0, 2], [v, 0, 0], 1), (ball(k, [0, 6, 2]),)))
        assert output.origin_moved_m is None
        v += (output.wire[0] + 0.2) * 0.05
        x += v * 0.05
    estimate, anchor = output.disturbance, brain._anchor
    commands = list(brain._commands)
    assert estimate[0] > 0.05
    after = brain.step(PilotInput(reset_at(60, [x + 7.0, -3.0, 2], [v - 2.0, 0, 0], 2), (ball(60, [0, 6, 2]),)))
    assert after.origin_moved_m == pytest.approx(np.hypot(7.0, 3.0), abs=0.2)
    np.testing.assert_array_equal(after.disturbance, estimate)  # the leap of the velocity is no force
    assert list(brain._commands)[:-1] == commands[-(len(brain._commands) - 1) :]  # they are still under way
    assert len(brain.tracks()) == 1
    assert anchor is not None
    assert brain._anchor is not None
    np.testing.assert_allclose(brain._anchor, [x + 7.0, -3.0, 2])
    assert brain.step(PilotInput(reset_at(61, [x + 7.0, -3.0, 2], [v - 2.0, 0, 0], 2))).origin_moved_m is None


def test_a_leap_of_the_position_counts_where_the_autopilot_counts_nothing() -> None:
    brain = pilot(Straight([0.0, 0.0, 0.0]))
    brain.step(PilotInput(vehicle(0, [0, 0, 2])))
    assert brain.step(PilotInput(vehicle(1, [0.9, 0, 2]))).origin_moved_m is None
    assert brain.step(PilotInput(vehicle(2, [2.0, 0, 2]))).origin_moved_m == pytest.approx(1.1)


def test_the_velocity_that_goes_with_a_setpoint_is_that_of_a_tick_later() -> None:
    brain = pilot(Straight([1.0, 0.0, 0.0]), delay={"actuation_s": 0.1})
    brain.step(PilotInput(vehicle(0, [0, 0, 2], [2, 0, 0])))
    brain.step(PilotInput(vehicle(1, [0.1, 0, 2], [2, 0, 0])))
    output = brain.step(PilotInput(vehicle(2, [0.2, 0, 2], [2, 0, 0])))
    # 1 m/s^2 over the two ticks until it acts, and over the one that it holds
    np.testing.assert_allclose(output.v_next, [2.15, 0, 0], atol=1e-12)


def test_a_pilot_configured_anew_flies_as_one_made_so() -> None:
    late = parse_config({"vehicle": {"profile": "ardupilot"}, "disturbance": {"enabled": False}})
    early = Pilot(parse_config({"vehicle": {"profile": "auto"}}), Straight([2.0, 0.0, 0.0]))
    fly(early, 5)
    made = Pilot(late, Straight([2.0, 0.0, 0.0]))
    for one, other in zip(fly(early.configured(late), 20), fly(made, 20), strict=True):
        np.testing.assert_array_equal(one.wire, other.wire)
        assert one.prediction.start_ns == other.prediction.start_ns


@pytest.mark.parametrize("goal", [[1.5, 0.0, 2.0], [3.0, 0.0, 2.0], [-4.0, 3.0, 3.0]])
def test_behind_a_slow_slew_it_arrives_and_stays(goal: list[float]) -> None:
    """A vehicle that follows by the jerk of ArduPilot's default, 5 m/s^3 of the level vector, and of the vertical."""
    brain = Pilot(parse_config({"vehicle": {"profile": "ardupilot"}, "delay": {"loop_s": 0.0, "actuation_s": 0.02}}))
    p, v, a = np.array([0.0, 0.0, 2.0]), np.zeros(3), np.zeros(3)
    farthest_m = 0.0
    for k in range(500):
        state = VehicleState(k * 20_000_000, frozen(p), frozen(v))
        asked = brain.step(PilotInput(vehicle=state, target_enu=frozen(goal))).wire
        change = asked - a
        change[:2] *= min(1.0, 0.1 / max(float(np.linalg.norm(change[:2])), 1e-9))
        a = a + np.array([change[0], change[1], np.clip(change[2], -0.1, 0.1)])
        p, v = p + v * 0.02 + a * 2e-4, v + a * 0.02
        if k >= 250:
            farthest_m = max(farthest_m, float(np.linalg.norm(p - goal)))
    assert farthest_m < 0.05


def test_a_pilot_names_its_artefact_and_a_law_of_your_own_has_none() -> None:
    class Nothing:
        def act(self, v_enu, error_enu):
            return np.zeros(3)

    folder = artifact_folder(Config().policy.artifact)
    assert Pilot(Config()).artifact == hashlib.sha256((folder / "manifest.json").read_bytes()).hexdigest()
    assert Pilot(Config(), Nothing()).artifact is None
