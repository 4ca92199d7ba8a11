"""An artefact is a contract: what fits flies, on both backends alike; what does not is refused in one line."""

from __future__ import annotations

import builtins
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import load_file, save

from companion.config import LimitsConfig, PolicyConfig
from companion.errors import ArtifactError
from companion.policy import MANIFEST, ONNX_FILE, WEIGHTS_FILE, Manifest, load_policy, read_manifest
from policies.env import EnvConfig
from policies.evaluation.artifact import evaluate
from policies.evaluation.pointmass import fly, random_starts
from policies.export import axis_shared_onnx, contract, write_artifact
from policies.network import AxisSharedNet

BUILTIN = Path(__file__).resolve().parents[2] / "policies" / "artifacts" / "default"


@pytest.fixture
def artifact(tmp_path: Path) -> Path:
    return Path(shutil.copytree(BUILTIN, tmp_path / "copy"))


def load(folder: Path, backend: Any = "onnx", limit_m_s2: float = 3.0) -> Any:
    config = PolicyConfig(artifact=str(folder), backend=backend, capture_radius_m=0.0)
    return load_policy(config, LimitsConfig(acceleration_m_s2=limit_m_s2))


def restate(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    manifest = msgspec.json.decode((folder / MANIFEST).read_bytes())
    change(manifest)
    (folder / MANIFEST).write_bytes(msgspec.json.encode(manifest))


def replace_file(folder: Path, name: str, data: bytes) -> None:
    (folder / name).write_bytes(data)
    restate(folder, lambda m: m["files"].update({name: hashlib.sha256(data).hexdigest()}))


def test_the_shipped_artefact_is_whole_and_small() -> None:
    manifest, digest = read_manifest(BUILTIN)
    assert set(manifest.files) == {ONNX_FILE, WEIGHTS_FILE}
    assert sum(path.stat().st_size for path in BUILTIN.iterdir()) < 200_000
    assert manifest.k_ma_m_s2 == 3.0
    assert load_policy(PolicyConfig(), LimitsConfig()).digest == digest


def test_it_flies_held_out_starts_as_its_manifest_states() -> None:
    """100 starts that neither training nor the manifest's evaluation drew, flown now."""
    stated = read_manifest(BUILTIN)[0].evaluation
    measured = evaluate(BUILTIN, starts=100, seed=20_011)
    assert measured["reached"] == 100
    assert measured["left_arena"] == 0
    assert measured["network_alone_passed_threshold"] == 100
    assert measured["time_over_bound_mean"] <= 1.25
    low, high = measured["time_over_bound_interval"]
    assert stated["time_over_bound_mean"] == pytest.approx(measured["time_over_bound_mean"], abs=1.5 * (high - low))


def test_provenance_is_stated() -> None:
    manifest, _ = read_manifest(BUILTIN)
    assert len(manifest.provenance["commit"]) == 40
    assert {"seed", "created", "packages", "processor"} <= set(manifest.provenance)
    assert manifest.training["train"]["seed"] == manifest.provenance["seed"]
    assert msgspec.convert(manifest.training["env"], EnvConfig).k_ma_m_s2 == manifest.k_ma_m_s2


def test_both_backends_give_the_same_actions() -> None:
    onnx_policy, torch_policy = load(BUILTIN), load(BUILTIN, "torch")
    rng = np.random.default_rng(0)
    for _ in range(2000):
        v, e = rng.uniform(-6.0, 6.0, 3), rng.uniform(-20.0, 20.0, 3) * 10.0 ** rng.uniform(-3.0, 0.0)
        np.testing.assert_allclose(onnx_policy.action(v, e), torch_policy.action(v, e), rtol=0.0, atol=1e-6)


def test_export_equals_the_network_that_was_trained() -> None:
    torch.manual_seed(0)
    net = AxisSharedNet(actor_width=8, critic_width=8)
    weights = {name: value.detach().numpy() for name, value in net.actor_weights().items()}
    session = _session(axis_shared_onnx(weights))
    rng = np.random.default_rng(1)
    observation = rng.uniform(-15.0, 15.0, (400, 6)).astype(np.float32)
    with torch.no_grad():
        trained = net.double().forward_actor(torch.from_numpy(observation).double()).clamp(-1.0, 1.0).numpy()
    assert np.mean(np.abs(trained) < 1.0) > 0.05  # the clip does not hide a difference
    np.testing.assert_allclose(session(observation), trained, rtol=0.0, atol=1e-6)


def test_the_normaliser_is_inside() -> None:
    """A network whose normaliser is doubled answers as the old one does at half the observation."""
    weights = load_file(BUILTIN / WEIGHTS_FILE)
    plain, doubled = (_session(axis_shared_onnx({**weights, "scale": k * weights["scale"]})) for k in (1.0, 2.0))
    observation = np.array([[1.0, -2.0, 0.5, 6.0, -3.0, 0.2]], dtype=np.float32)
    np.testing.assert_allclose(doubled(2.0 * observation), plain(observation), atol=1e-7)
    assert np.abs(doubled(observation) - plain(observation)).max() > 0.01


def test_the_same_weights_give_the_same_bytes() -> None:
    weights = load_file(BUILTIN / WEIGHTS_FILE)
    assert axis_shared_onnx(weights) == axis_shared_onnx(weights) == (BUILTIN / ONNX_FILE).read_bytes()


def test_it_flies_from_held_out_starts() -> None:
    policy = load_policy(PolicyConfig(), LimitsConfig())
    config = EnvConfig()
    p, v, target = random_starts(config, 200, seed=90_001)
    flights = fly(policy.act, p, v, target, config=config, a_max_m_s2=3.0)
    assert flights.reached.all()
    assert not flights.left_arena.any()
    assert np.mean(flights.time_s / flights.bound_s) <= 1.25
    assert flights.speed_max_m_s.max() <= 6.0


def test_it_also_arrives_from_any_velocity_after_an_evasion() -> None:
    policy = load_policy(PolicyConfig(), LimitsConfig())
    rng = np.random.default_rng(90_002)
    p, target = rng.uniform(-5.0, 5.0, (2, 60, 3))
    v = rng.normal(size=(60, 3))
    v *= 5.0 / np.linalg.norm(v, axis=1, keepdims=True)
    assert fly(policy.act, p, v, target, config=EnvConfig(), a_max_m_s2=3.0).reached.all()


REFUSALS: list[tuple[Callable[[dict[str, Any]], None], str]] = [
    (lambda m: m.update(format="companion-policy/9"), r"format: expected 'companion-policy/1', got"),
    (lambda m: m["observation"].update(fields=["e_x"] * 6), r"observation.fields: expected \('v_x'"),
    (lambda m: m["observation"].update(units=["km"] * 6), r"observation.units: expected \('m/s'"),
    (lambda m: m["observation"].update(frame="local_ned"), r"observation.frame: expected 'local_enu', got 'local_ned'"),
    (lambda m: m["observation"].update(dtype="float64"), r"observation.dtype: expected 'float32'"),
    (lambda m: m["observation"].update(high=[1.0]), r"observation.high: expected 6, got 1"),
    (lambda m: m["observation"].update(high=[0.0] * 6), r"observation.high: expected a positive number, got 0.0"),
    (lambda m: m["action"].update(name="thrust"), r"action.name: expected 'action', got 'thrust'"),
    (lambda m: m["action"].update(high=[2.0] * 3), r"action.high: expected \(1.0, 1.0, 1.0\)"),
    (lambda m: m.update(k_ma_m_s2=12.0), r"k_ma_m_s2: expected at most limits.acceleration_m_s2 3.0, got 12.0"),
    (lambda m: m.update(k_ma_m_s2=-1.0), r"k_ma_m_s2: expected a positive number, got -1.0"),
    (lambda m: m.pop("k_ma_m_s2"), r"missing required field `k_ma_m_s2`"),
    (lambda m: m.update(dt_s="fast"), r"Expected `float`, got `str` - at `\$.dt_s`"),
    (lambda m: m["files"].pop(ONNX_FILE), r"files: expected an entry policy.onnx"),
]


@pytest.mark.parametrize(("change", "message"), REFUSALS, ids=[message[:28] for _, message in REFUSALS])
def test_another_contract_is_refused(artifact: Path, change: Callable[[dict[str, Any]], None], message: str) -> None:
    restate(artifact, change)
    with pytest.raises(ArtifactError, match=message) as caught:
        load(artifact)
    assert "\n" not in str(caught.value)
    assert str(artifact) in str(caught.value)


@pytest.mark.parametrize("backend", ["onnx", "torch"])
def test_a_changed_file_is_refused(artifact: Path, backend: str) -> None:
    name = ONNX_FILE if backend == "onnx" else WEIGHTS_FILE
    data = bytearray((artifact / name).read_bytes())
    data[-1] ^= 1
    (artifact / name).write_bytes(bytes(data))
    with pytest.raises(ArtifactError, match=rf"{name}: SHA-256: expected [0-9a-f]+... of the manifest, got"):
        load(artifact, backend)


@pytest.mark.parametrize("where", ["builtin:none", "builtin:../../companion", "/nowhere/at/all", ""])
def test_a_missing_artefact_is_refused(where: str) -> None:
    with pytest.raises(ArtifactError, match=r"policy.artifact: .* expected a folder with manifest.json"):
        load_policy(PolicyConfig(artifact=where), LimitsConfig())


def test_a_missing_file_is_refused(artifact: Path) -> None:
    (artifact / ONNX_FILE).unlink()
    with pytest.raises(ArtifactError, match=r"policy.onnx: expected a file"):
        load(artifact)


def test_a_manifest_that_is_not_json_is_refused(artifact: Path) -> None:
    (artifact / MANIFEST).write_bytes(b"\xff{")
    with pytest.raises(ArtifactError, match=MANIFEST):
        load(artifact)


@pytest.mark.parametrize(
    ("backend", "name", "message"),
    [("onnx", ONNX_FILE, "expected an ONNX model"), ("torch", WEIGHTS_FILE, "expected safetensors")],
)
def test_files_of_another_kind_are_refused(artifact: Path, backend: str, name: str, message: str) -> None:
    replace_file(artifact, name, b"\x80\x04not a model at all")
    with pytest.raises(ArtifactError, match=message):
        load(artifact, backend)


def test_weights_that_do_not_fit_together_are_refused(artifact: Path) -> None:
    weights = load_file(artifact / WEIGHTS_FILE)
    weights["hidden.weight"] = weights["hidden.weight"][:, :-1].copy()
    replace_file(artifact, WEIGHTS_FILE, save(weights))
    with pytest.raises(ArtifactError, match="weights: expected those of a network of kind axis_shared"):
        load(artifact, "torch")


def test_an_unknown_kind_of_network_is_refused_by_torch(artifact: Path) -> None:
    restate(artifact, lambda m: m["network"].update(kind="transformer"))
    with pytest.raises(ArtifactError, match=r"network.kind: expected axis_shared or mlp, got 'transformer'"):
        load(artifact, "torch")


def test_a_model_with_another_signature_is_refused(artifact: Path) -> None:
    replace_file(artifact, ONNX_FILE, _linear_model(np.eye(6)[:, :4]))
    with pytest.raises(ArtifactError, match=r"signature: expected .*\[6\].*\[3\].* got .*\[4\]"):
        load(artifact)


def test_a_network_that_answers_nan_is_refused_before_take_off(artifact: Path) -> None:
    replace_file(artifact, ONNX_FILE, _linear_model(np.full((6, 3), np.nan)))
    with pytest.raises(ArtifactError, match="network: expected three finite actions"):
        load(artifact)


def test_torch_missing_is_said_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def without_torch(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
        return original(name, *args, **kwargs)

    monkeypatch.delitem(__import__("sys").modules, "companion.torch_backend", raising=False)
    monkeypatch.setattr(builtins, "__import__", without_torch)
    with pytest.raises(ArtifactError, match=r'policy.backend: expected "onnx", or torch .* \(torch is not\)'):
        load(BUILTIN, "torch")


def test_a_foreign_network_flies_if_it_states_the_same_contract(tmp_path: Path) -> None:
    """A perceptron made elsewhere: its ONNX from its own exporter (here by hand), its weights named plainly."""
    rng = np.random.default_rng(3)
    weights = {
        "mean": np.zeros(6, dtype=np.float32),
        "scale": np.array([2.0] * 3 + [4.0] * 3, dtype=np.float32),
        "layers.0.weight": rng.normal(size=(16, 6)).astype(np.float32),
        "layers.0.bias": rng.normal(size=16).astype(np.float32),
        "layers.1.weight": rng.normal(size=(3, 16)).astype(np.float32) * np.float32(0.2),
        "layers.1.bias": np.zeros(3, dtype=np.float32),
    }
    manifest = msgspec.structs.replace(
        contract(EnvConfig(k_ma_m_s2=2.0), "foreign"), network={"kind": "mlp", "activation": "tanh"}
    )
    write_artifact(tmp_path, manifest, {ONNX_FILE: _mlp_model(weights), WEIGHTS_FILE: save(weights)})
    policies = [load(tmp_path, backend) for backend in ("onnx", "torch")]
    v, e = np.array([1.0, 0.5, -0.2]), np.array([3.0, -2.0, 1.0])
    hidden = np.tanh(
        weights["layers.0.weight"] @ (np.concatenate([v, e]) / weights["scale"]) + weights["layers.0.bias"]
    )
    expected = 2.0 * np.clip(weights["layers.1.weight"] @ hidden, -1.0, 1.0)
    for policy in policies:
        np.testing.assert_allclose(policy.act(v, e), expected, atol=1e-5)
    assert isinstance(policies[0].manifest, Manifest)


def _session(model: bytes) -> Callable[[Any], Any]:
    import onnxruntime

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return lambda observation: session.run(None, {"observation": observation})[0]


def _model(nodes: list[Any], constants: dict[str, Any], columns: int = 3) -> bytes:
    graph = helper.make_graph(
        nodes,
        "foreign",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["N", 6])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", columns])],
        [numpy_helper.from_array(np.ascontiguousarray(v, dtype=np.float32), k) for k, v in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def _linear_model(matrix: Any) -> bytes:
    return _model([helper.make_node("MatMul", ["observation", "w"], ["action"])], {"w": matrix}, matrix.shape[1])


def _mlp_model(weights: dict[str, Any]) -> bytes:
    nodes = [
        helper.make_node("Div", ["observation", "scale"], ["x"]),
        helper.make_node("Gemm", ["x", "w0", "b0"], ["h"], transB=1),
        helper.make_node("Tanh", ["h"], ["t"]),
        helper.make_node("Gemm", ["t", "w1", "b1"], ["action"], transB=1),
    ]
    names = {"w0": "layers.0.weight", "b0": "layers.0.bias", "w1": "layers.1.weight", "b1": "layers.1.bias"}
    return _model(nodes, {"scale": weights["scale"], **{k: weights[v] for k, v in names.items()}})
