"""Write an artefact: network as ONNX and safetensors, manifest with contract, provenance, figures and hashes.

The ONNX graph is written node by node from the weights, not traced: it is the same bytes for the same weights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import save

from companion.policy import (
    ACTION_FIELDS,
    FORMAT,
    FRAME,
    MANIFEST,
    OBSERVATION_FIELDS,
    OBSERVATION_UNITS,
    ONNX_FILE,
    WEIGHTS_FILE,
    Manifest,
    VectorSpec,
)
from companion.torch_backend import FINE
from policies.env import EnvConfig

Arrays = Mapping[str, npt.NDArray[np.float32]]
OPSET, IR_VERSION = 17, 9  # readable by every ONNX Runtime since 1.14


def axis_shared_onnx(weights: Arrays) -> bytes:
    """`companion.torch_backend.axis_shared` with its clip as an ONNX model: observation (N, 6) -> action (N, 3).

    A node costs more than its arithmetic, so axes and signs are unrolled into few wide ones: one matrix scales and sums
    (the normaliser), one is g's first layer for +x, +y, +z, -x, -y, -z, and the hidden layer works on six rows.
    Inside it is float64, so that the order of additions leaves no trace in the float32 that comes out.
    """
    return _serialised(_nodes(), _constants(weights))


def _constants(weights: Arrays) -> dict[str, npt.NDArray[Any]]:
    odd, even = weights["odd.weight"].astype(np.float64), weights["even.weight"].astype(np.float64)
    per_axis = np.vstack([np.kron(np.eye(3), odd[:, k]) for k in range(3)])  # (9, 3 H): rows v, e, fine
    unit = np.kron(np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 1.0, FINE]]), np.eye(3))  # v, e, v + e, FINE e
    width = weights["hidden.bias"].shape[0]
    return {
        "scale_w": unit / weights["scale"].astype(np.float64)[:, None],
        "sum_w": np.kron(np.eye(3), np.ones((3, 1))),
        "first_w": np.vstack([np.hstack([per_axis, -per_axis]), np.tile(even.T, 6)]),
        "first_b": np.tile(weights["even.bias"].astype(np.float64), 6),
        "hidden_w": weights["hidden.weight"].T.astype(np.float64),
        "hidden_b": weights["hidden.bias"].astype(np.float64),
        "out_w": np.kron(np.vstack([np.eye(3), -np.eye(3)]), weights["out.weight"].astype(np.float64).reshape(-1, 1)),
        "low": np.array(-1.0),
        "high": np.array(1.0),
        "parts": np.array([6, 3, 3], dtype=np.int64),
        "rows": np.array([-1, width], dtype=np.int64),
        "whole": np.array([-1, 6 * width], dtype=np.int64),
    }


def _nodes() -> list[onnx.NodeProto]:
    node = helper.make_node
    return [
        node("Cast", ["observation"], ["wide"], to=TensorProto.DOUBLE),
        node("MatMul", ["wide", "scale_w"], ["scaled"]),
        node("Split", ["scaled", "parts"], ["v_e", "v_plus_e", "fine_e"], axis=1),
        node("Abs", ["fine_e"], ["fine_abs"]),  # Softsign has no float64 kernel
        node("Add", ["fine_abs", "high"], ["fine_below"]),
        node("Div", ["fine_e", "fine_below"], ["fine"]),
        node("Concat", ["v_e", "v_plus_e"], ["vectors"], axis=1),
        node("Mul", ["vectors", "vectors"], ["squares"]),
        node("MatMul", ["squares", "sum_w"], ["sums"]),
        node("Sqrt", ["sums"], ["lengths"]),
        node("Concat", ["v_e", "fine", "lengths"], ["features"], axis=1),
        node("Gemm", ["features", "first_w", "first_b"], ["first_in"]),
        node("Relu", ["first_in"], ["first"]),
        node("Reshape", ["first", "rows"], ["first_rows"]),
        node("Gemm", ["first_rows", "hidden_w", "hidden_b"], ["second_in"]),
        node("Relu", ["second_in"], ["second_rows"]),
        node("Reshape", ["second_rows", "whole"], ["second"]),
        node("MatMul", ["second", "out_w"], ["raw"]),
        node("Clip", ["raw", "low", "high"], ["clipped"]),
        node("Cast", ["clipped"], ["action"], to=TensorProto.FLOAT),
    ]


def _serialised(nodes: list[onnx.NodeProto], constants: Mapping[str, npt.NDArray[Any]]) -> bytes:
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["N", 6])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 3])],
        [numpy_helper.from_array(np.ascontiguousarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def contract(env: EnvConfig, name: str) -> Manifest:
    """The manifest of a policy trained in ``env``, files and evidence still empty."""
    span_m = 2.0 * env.arena_m
    fastest_m_s = env.speed_limit_m_s if env.overspeed_cost > 0.0 else float(np.sqrt(2.0 * env.k_ma_m_s2 * span_m))
    high = (fastest_m_s,) * 3 + (span_m,) * 3
    return Manifest(
        format=FORMAT,
        name=name,
        observation=VectorSpec(
            "observation", "float32", OBSERVATION_FIELDS, OBSERVATION_UNITS, FRAME, tuple(-x for x in high), high
        ),
        action=VectorSpec("action", "float32", ACTION_FIELDS, ("1",) * 3, FRAME, (-1.0,) * 3, (1.0,) * 3),
        k_ma_m_s2=env.k_ma_m_s2,
        dt_s=env.dt_s,
        files={},
    )


def write_artifact(folder: Path, manifest: Manifest, files: Mapping[str, bytes]) -> None:
    """Write ``files`` and a manifest that holds their hashes; the folder is made."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    stated = msgspec.structs.replace(manifest, files=hashes)
    (folder / MANIFEST).write_bytes(msgspec.json.format(msgspec.json.encode(stated), indent=1) + b"\n")


def network_files(weights: Arrays) -> dict[str, bytes]:
    """Both forms of an axis-shared network, by file name."""
    return {ONNX_FILE: axis_shared_onnx(weights), WEIGHTS_FILE: save(dict(weights))}
