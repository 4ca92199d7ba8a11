"""Training: PPO that learns, the same seed the same weights, resuming, and the command line around it."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.errors import ArtifactError
from policies.cli import main
from policies.env import PRESETS, EnvConfig
from policies.evaluation.pointmass import fly, report, time_optimal_s
from policies.evaluation.statistics import wilson
from policies.train import TRAIN_PRESETS, CurvePoint, TrainConfig, build, train

SMALL = TrainConfig(seed=3, steps=16_384, vehicles=64, rollout=32, batch=512, epochs=2, actor_width=8, critic_width=8)
NEAR = replace(PRESETS["default"], arena_m=2.0, max_steps=60, start_speed_m_s=0.0, wall_share=0.0)


def test_a_short_training_improves_the_return() -> None:
    points: list[CurvePoint] = []
    easy = replace(NEAR, threshold_m=0.3, lag_spread_s=0.0, gain_loss=0.0, bias_std_m_s2=0.0)
    config = replace(SMALL, steps=40_960, epochs=4, learning_rate=3e-3, actor_width=16, critic_width=16)
    train(easy, config, on_point=points.append)
    assert [point.steps for point in points] == list(range(2048, 40_961, 2048))
    assert points[-1].mean_return > points[4].mean_return + 20.0
    assert points[0].success == 0.0
    assert points[-1].success > 0.7


def test_the_same_seed_gives_the_same_weights() -> None:
    config = replace(SMALL, steps=4096)
    first, second, other = (train(NEAR, c).weights for c in (config, config, replace(config, seed=4)))
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
    assert np.abs(first["hidden.weight"] - other["hidden.weight"]).max() > 1e-3


def test_resuming_goes_on_from_the_checkpoint(tmp_path: Path) -> None:
    train(NEAR, replace(SMALL, steps=4096, checkpoints=2), checkpoints=tmp_path)
    checkpoint = tmp_path / "4096.safetensors"
    assert {path.name for path in tmp_path.iterdir()} == {"2048.safetensors", "4096.safetensors"}
    points: list[CurvePoint] = []
    resumed = train(NEAR, replace(SMALL, steps=6144), resume=checkpoint, on_point=points.append)
    assert [point.steps for point in points] == [6144]
    stopped = train(NEAR, replace(SMALL, steps=4096), resume=checkpoint)
    assert np.abs(resumed.weights["hidden.weight"] - stopped.weights["hidden.weight"]).max() > 1e-4


def test_a_checkpoint_restores_parameters_and_moments(tmp_path: Path) -> None:
    from policies.checkpoint import restore_checkpoint, save_checkpoint

    model = build(NEAR, SMALL)
    model.learn(2048)
    save_checkpoint(model, tmp_path / "a.safetensors")
    other = build(NEAR, replace(SMALL, seed=9))
    restore_checkpoint(other, tmp_path / "a.safetensors")
    assert other.num_timesteps == 2048
    mine, theirs = (m.policy.optimizer.state_dict()["state"] for m in (model, other))
    assert mine.keys() == theirs.keys()
    for i in mine:
        for name in ("step", "exp_avg", "exp_avg_sq"):
            np.testing.assert_array_equal(mine[i][name], theirs[i][name])


def test_a_checkpoint_of_another_network_is_refused(tmp_path: Path) -> None:
    train(NEAR, replace(SMALL, steps=2048, checkpoints=1), checkpoints=tmp_path)
    with pytest.raises(ArtifactError, match="expected a checkpoint written by `policies train`"):
        train(NEAR, replace(SMALL, actor_width=16), resume=tmp_path / "2048.safetensors")
    (tmp_path / "pickle").write_bytes(b"\x80\x04.")
    with pytest.raises(ArtifactError, match="pickle: expected a checkpoint"):
        train(NEAR, SMALL, resume=tmp_path / "pickle")


def test_the_bound_is_bang_bang_on_the_longest_axis() -> None:
    d = np.array([[3.0, -12.0, 0.0]])
    np.testing.assert_allclose(time_optimal_s(d, 3.0), [4.0])  # 12 = 3 t^2 / 4

    def bang_bang(v: np.ndarray, e: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        return np.sign(e - v * np.abs(v) / 6.0) * 3.0

    start, target = np.zeros((1, 3)), np.array([[0.0, -12.0, 0.0]])
    config = EnvConfig(lag_s=0.0, dt_s=0.001, arena_m=20.0)
    flights = fly(bang_bang, start, start, target, config=config, a_max_m_s2=3.0)
    # it passes 0.1 m before the target: sqrt(2 x 0.1 / 3) s earlier
    assert flights.time_s[0] == pytest.approx(4.0 - np.sqrt(0.2 / 3.0), abs=0.01)


def test_a_flight_that_passes_and_does_not_stay_has_not_reached() -> None:
    start, target = np.zeros((1, 3)), np.array([[6.0, 0.0, 0.0]])
    config = EnvConfig(arena_m=100.0)

    def through(v: np.ndarray, e: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        return np.array([3.0, 0.0, 0.0]) if v[0] < 3.0 else np.zeros(3)

    flights = fly(through, start, start, target, config=config, a_max_m_s2=3.0, timeout_s=10.0)
    assert flights.passed[0]
    assert not flights.reached[0]
    assert report(flights, seed=0)["reached"] == 0


def test_wilson_against_the_published_example() -> None:
    low, high = wilson(15, 100)  # Newcombe 1998: 0.0931 to 0.2328
    assert (low, high) == (pytest.approx(0.0931, abs=1e-4), pytest.approx(0.2328, abs=1e-4))


def test_the_command_leaves_a_run_folder_that_flies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    status = main(["train", "--seed", "1", "--steps", "4096", "--out", str(run), "--starts", "3", "--json"])
    outcome = json.loads(capsys.readouterr().out)
    assert status == (0 if outcome["evaluation"]["reached"] == 3 else 1)
    names = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    assert {"config.json", "curve.csv", "curves.png", "artifact/manifest.json", "artifact/policy.onnx"} <= names
    assert main(["evaluate", str(run / "artifact"), "--starts", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["starts"] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "builtin:none"], "policies: policy.artifact: builtin:none: expected a folder"),
        (["train", "--resume", "/nowhere.safetensors", "--out", "OUT"], "/nowhere.safetensors: expected a checkpoint"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path) if x == "OUT" else x for x in arguments]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("policies:")]
    assert len(said) == 1
    assert message in said[0]


@pytest.mark.parametrize(
    ("arguments", "module", "extra"),
    [
        (["train"], "torch", "train"),
        (["paper"], "pybullet", "sim"),
        (["evaluate", "builtin:default", "--plant", "pybullet"], "pybullet", "sim"),
    ],
)
def test_a_missing_extra_is_named(
    arguments: list[str], module: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == module else found(name))
    assert main(arguments) == 2
    said = f"policies: {' '.join(arguments[:1])}"
    err = capsys.readouterr().err
    assert err.startswith(said)
    assert err.endswith(f": {module} is not installed, expected companion-safety[{extra}]\n")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_training_from_the_record_reaches_the_shipped_success(tmp_path: Path) -> None:
    from policies.run import run

    outcome = run(PRESETS["default"], TRAIN_PRESETS["default"], tmp_path, name="again")
    assert outcome["evaluation"]["reached"] == 1000
    assert outcome["evaluation"]["time_over_bound_mean"] <= 1.25
