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
from policies.env import EnvConfig

Arrays = Mapping[str, npt.NDArray[np.float32]]
OPSET, IR_VERSION = 17, 9  # readable by every ONNX Runtime since 1.14


def axis_shared_onnx(weights: Arrays) -> bytes:
    """`companion.torch_backend.axis_shared` with its clip as an ONNX model: observation (N, 6) -> action (N, 3)."""
    constants: dict[str, npt.NDArray[Any]] = {
        "scale": weights["scale"],
        "odd_w": weights["odd.weight"].T,
        "even_w": weights["even.weight"].T,
        "even_b": weights["even.bias"],
        "hidden_w": weights["hidden.weight"].T,
        "hidden_b": weights["hidden.bias"],
        "out_w": weights["out.weight"].T,
        "tiny": np.float32(1e-3),
        "low": np.float32(-1.0),
        "high": np.float32(1.0),
        "one": np.array([1], dtype=np.int64),
        "two": np.array([2], dtype=np.int64),
        "halves": np.array([3, 3], dtype=np.int64),
    }
    node = helper.make_node
    nodes = [
        node("Div", ["observation", "scale"], ["o"]),
        node("Split", ["o", "halves"], ["v", "e"], axis=1),
        node("Sign", ["e"], ["e_sign"]),
        node("Abs", ["e"], ["e_abs"]),
        node("Sqrt", ["e_abs"], ["e_sqrt"]),
        node("Mul", ["e_sign", "e_sqrt"], ["e_root"]),
        *[node("Unsqueeze", [name, "two"], [f"{name}_column"]) for name in ("v", "e", "e_root")],
        node("Concat", ["v_column", "e_column", "e_root_column"], ["odd_in"], axis=2),
        node("MatMul", ["odd_in", "odd_w"], ["odd"]),
        node("ReduceL2", ["e"], ["distance"], axes=[1], keepdims=1),
        node("ReduceL2", ["v"], ["speed"], axes=[1], keepdims=1),
        node("Sqrt", ["distance"], ["distance_root"]),
        node("Mul", ["v", "e"], ["ve"]),
        node("ReduceSum", ["ve", "one"], ["dot"], keepdims=1),
        node("Add", ["distance", "tiny"], ["distance_safe"]),
        node("Div", ["dot", "distance_safe"], ["closing"]),
        node("Concat", ["distance", "distance_root", "speed", "closing"], ["even_in"], axis=1),
        node("MatMul", ["even_in", "even_w"], ["even_product"]),
        node("Add", ["even_product", "even_b"], ["even_row"]),
        node("Unsqueeze", ["even_row", "one"], ["even"]),
        *_branch("plus", "Add"),
        *_branch("minus", "Sub"),
        node("Sub", ["plus_second", "minus_second"], ["difference"]),
        node("MatMul", ["difference", "out_w"], ["column"]),
        node("Squeeze", ["column", "two"], ["raw"]),
        node("Clip", ["raw", "low", "high"], ["action"]),
    ]
    return _serialised(nodes, constants)


def _branch(name: str, combine: str) -> list[onnx.NodeProto]:
    """g(+-o_i, s) up to its last layer."""
    node = helper.make_node
    return [
        node(combine, ["even", "odd"], [f"{name}_in"]),
        node("Relu", [f"{name}_in"], [f"{name}_first"]),
        node("MatMul", [f"{name}_first", "hidden_w"], [f"{name}_product"]),
        node("Add", [f"{name}_product", "hidden_b"], [f"{name}_sum"]),
        node("Relu", [f"{name}_sum"], [f"{name}_second"]),
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
