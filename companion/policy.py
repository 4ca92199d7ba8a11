"""The reference: a_ref = k_ma pi([v, e]) far out, a_ref = kp e - kd v where the vehicle is captured.

An artefact is a folder with ``manifest.json``, the network (``policy.onnx``, and ``weights.safetensors`` for the torch
backend), and the SHA-256 of both. The manifest states a contract; what does not fit it is refused before take-off.
Accelerations are net: gravity is in nobody's account (8). Frame: local ENU.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from companion.config import LimitsConfig, PolicyConfig
from companion.errors import ArtifactError, PolicyOutputInvalid
from companion.types import Vec3

Float32 = npt.NDArray[np.float32]
Network = Callable[[Float32], Float32]  # (1, 6) -> (1, 3)

FORMAT = "companion-policy/1"
MANIFEST, ONNX_FILE, WEIGHTS_FILE = "manifest.json", "policy.onnx", "weights.safetensors"
OBSERVATION_FIELDS = ("v_x", "v_y", "v_z", "e_x", "e_y", "e_z")  # e = target - position
OBSERVATION_UNITS = ("m/s",) * 3 + ("m",) * 3
ACTION_FIELDS = ("a_x", "a_y", "a_z")  # net acceleration / k_ma
FRAME = "local_enu"
MAX_FILE_BYTES = 64 * 2**20
BRAKING_SHARE = 0.8  # of the limit: what the hold law counts on for stopping, lag left aside
_LOAD_ERRORS = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
)


class VectorSpec(msgspec.Struct, frozen=True):
    """A named tensor of shape (N, len(fields)), float32."""

    name: str
    dtype: str
    fields: tuple[str, ...]
    units: tuple[str, ...]
    frame: str
    low: tuple[float, ...]  # range of training; the action is clipped to it inside the network
    high: tuple[float, ...]


class Manifest(msgspec.Struct, frozen=True):
    """What an artefact states about itself. The last four are evidence, not contract."""

    format: str
    name: str
    observation: VectorSpec
    action: VectorSpec
    k_ma_m_s2: float
    dt_s: float
    files: dict[str, str]  # name -> SHA-256
    network: dict[str, Any] = {}  # what the torch backend rebuilds
    training: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    evaluation: dict[str, Any] = {}


def brake(v_enu: Vec3, config: PolicyConfig, limit_m_s2: float) -> Vec3:
    """a = clip(-kd v, -limit, limit) per axis: to hover, wherever that ends [m/s^2]."""
    return np.clip(-config.hold_kd * v_enu, -limit_m_s2, limit_m_s2)


def hold(error_enu: Vec3, v_enu: Vec3, config: PolicyConfig, limit_m_s2: float) -> Vec3:
    """a = clip(kp e - kd v, -limit, limit) per axis, e = where to be - where it is [m/s^2]."""
    return np.clip(config.hold_kp * error_enu - config.hold_kd * v_enu, -limit_m_s2, limit_m_s2)


def capture_weight(v_enu: Vec3, error_enu: Vec3, radius_m: float, braking_m_s2: float) -> float:
    """Share of the hold law: w = clip(2 - 2 max(|e|, |e_s|) / R, 0, 1), e_s = e - v |v| / (2 a_b).

    e_s is the error left where braking would end: the hold law flies where both ends lie within R / 2, the policy where
    one is beyond R, a mean of the two between. w is continuous and has no memory, so there is nothing to get stuck in;
    at rest the hold law points at the target, and a mean with a policy that does too has no zero but the target.
    """
    if radius_m <= 0.0:
        return 0.0
    (vx, vy, vz), (ex, ey, ez) = v_enu.tolist(), error_enu.tolist()
    stop_s = math.sqrt(vx * vx + vy * vy + vz * vz) / (2.0 * braking_m_s2)
    here = ex * ex + ey * ey + ez * ez
    there = (ex - vx * stop_s) ** 2 + (ey - vy * stop_s) ** 2 + (ez - vz * stop_s) ** 2
    return min(1.0, max(0.0, 2.0 - 2.0 * math.sqrt(max(here, there)) / radius_m))


class Policy:
    """A loaded artefact as a function of the vehicle's velocity and its error to the target."""

    def __init__(
        self, manifest: Manifest, digest: str, network: Network, config: PolicyConfig, limits: LimitsConfig
    ) -> None:
        self.manifest, self.digest = manifest, digest  # digest: SHA-256 of the manifest, which holds the files'
        self.network, self._config, self._limit_m_s2 = network, config, limits.acceleration_m_s2
        self._reach_m = min(manifest.observation.high[3:])
        self._observation: Float32 = np.zeros((1, 6), dtype=np.float32)

    def act(self, v_enu: Vec3, error_enu: Vec3) -> Vec3:
        """Net reference acceleration k_ma pi([v, e]), blended into `hold` by `capture_weight` [m/s^2].

        An error beyond the range of training is shortened along its direction: far targets are flown to as the
        farthest one known.

        Args:
            v_enu, error_enu: velocity, and target minus position, shape (3,) [m/s], [m].
        Raises:
            PolicyOutputInvalid: the network's answer, or what it was asked, is not finite.
        """
        w = capture_weight(v_enu, error_enu, self._config.capture_radius_m, BRAKING_SHARE * self._limit_m_s2)
        if w >= 1.0:
            return hold(error_enu, v_enu, self._config, self._limit_m_s2)
        a_enu = self.manifest.k_ma_m_s2 * self.action(v_enu, error_enu)
        if w > 0.0:
            a_enu = (1.0 - w) * a_enu + w * hold(error_enu, v_enu, self._config, self._limit_m_s2)
        return a_enu

    def within(self, limits: LimitsConfig) -> Policy:
        """The same network under other limits.

        Raises:
            ArtifactError: it asks for more than they allow.
        """
        check_limits(self.manifest, limits, self.manifest.name)
        return Policy(self.manifest, self.digest, self.network, self._config, limits)

    def action(self, v_enu: Vec3, error_enu: Vec3) -> Vec3:
        """The network alone: pi([v, e]) in [-1, 1]^3, float64."""
        (vx, vy, vz), (ex, ey, ez) = v_enu.tolist(), error_enu.tolist()
        farthest_m = max(abs(ex), abs(ey), abs(ez))
        share = 1.0 if farthest_m <= self._reach_m else self._reach_m / farthest_m
        self._observation[0] = (vx, vy, vz, share * ex, share * ey, share * ez)
        x, y, z = self.network(self._observation)[0].tolist()
        if not math.isfinite(x + y + z + vx + vy + vz + ex + ey + ez):  # a rectifier may swallow a NaN
            raise PolicyOutputInvalid(f"policy {self.manifest.name}: action {[x, y, z]}, expected finite numbers")
        return np.array([min(1.0, max(-1.0, x)), min(1.0, max(-1.0, y)), min(1.0, max(-1.0, z))])


def load_policy(config: PolicyConfig, limits: LimitsConfig) -> Policy:
    """The policy of ``config.artifact`` on ``config.backend``, checked against the contract.

    Raises:
        ArtifactError: one line that names the file and field and what was expected.
    """
    folder = artifact_folder(config.artifact)
    manifest, digest = read_manifest(folder)
    check_contract(manifest, folder)
    check_limits(manifest, limits, folder / MANIFEST)
    if config.backend == "torch":
        from companion.torch_backend import load_network

        network: Network = load_network(verified(folder, WEIGHTS_FILE, manifest), manifest, folder / WEIGHTS_FILE)
    else:
        network = onnx_network(verified(folder, ONNX_FILE, manifest), folder / ONNX_FILE, manifest)
    probe = network(np.zeros((1, 6), dtype=np.float32))
    if probe.shape != (1, 3) or not np.isfinite(probe).all():
        raise ArtifactError(f"{folder}: network: expected three finite actions at rest on the target, got {probe}")
    return Policy(manifest, digest, network, config, limits)


def artifact_folder(artifact: str) -> Path:
    """The folder named by ``policy.artifact``; ``builtin:NAME`` lies in the policies package beside this one."""
    kind, found, name = artifact.partition(":")
    folder = Path(artifact)
    if found and kind == "builtin":
        folder = Path(__file__).resolve().parent.parent / "policies" / "artifacts" / name
    if not (folder / MANIFEST).is_file():
        raise ArtifactError(f"policy.artifact: {artifact}: expected a folder with {MANIFEST}, none at {folder}")
    return folder


def read_manifest(folder: Path) -> tuple[Manifest, str]:
    """The decoded manifest and the SHA-256 of its bytes."""
    data = (folder / MANIFEST).read_bytes()
    try:
        return msgspec.json.decode(data, type=Manifest), hashlib.sha256(data).hexdigest()
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ArtifactError(f"{folder / MANIFEST}: {error}") from None


def check_limits(manifest: Manifest, limits: LimitsConfig, source: Path | str) -> None:
    """Refuse a policy that was made for a stronger vehicle."""
    if manifest.k_ma_m_s2 > limits.acceleration_m_s2 + 1e-9:
        raise ArtifactError(
            f"{source}: k_ma_m_s2: expected at most limits.acceleration_m_s2 "
            f"{limits.acceleration_m_s2}, got {manifest.k_ma_m_s2}"
        )


def check_contract(manifest: Manifest, folder: Path) -> None:
    """Refuse what was made for another observation, action, frame or unit."""
    observation, action = manifest.observation, manifest.action
    expected: list[tuple[str, Any, Any]] = [
        ("format", manifest.format, FORMAT),
        ("observation.name", observation.name, "observation"),
        ("observation.dtype", observation.dtype, "float32"),
        ("observation.fields", observation.fields, OBSERVATION_FIELDS),
        ("observation.units", observation.units, OBSERVATION_UNITS),
        ("observation.frame", observation.frame, FRAME),
        ("action.name", action.name, "action"),
        ("action.dtype", action.dtype, "float32"),
        ("action.fields", action.fields, ACTION_FIELDS),
        ("action.units", action.units, ("1",) * 3),
        ("action.frame", action.frame, FRAME),
        ("action.low", action.low, (-1.0,) * 3),
        ("action.high", action.high, (1.0,) * 3),
        ("observation.high", len(observation.high), 6),
    ]
    for name, got, want in expected:
        if got != want:
            raise ArtifactError(f"{folder / MANIFEST}: {name}: expected {want!r}, got {got!r}")
    positive = {"k_ma_m_s2": manifest.k_ma_m_s2, "dt_s": manifest.dt_s, "observation.high": min(observation.high)}
    for name, value in positive.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ArtifactError(f"{folder / MANIFEST}: {name}: expected a positive number, got {value}")


def verified(folder: Path, name: str, manifest: Manifest) -> bytes:
    """The bytes of a file of the artefact, equal to those that the manifest was written for."""
    path, want = folder / name, manifest.files.get(name)
    if want is None:
        raise ArtifactError(f"{folder / MANIFEST}: files: expected an entry {name} for this backend")
    if not path.is_file() or path.stat().st_size > MAX_FILE_BYTES:
        raise ArtifactError(f"{path}: expected a file of at most {MAX_FILE_BYTES} bytes")
    data = path.read_bytes()
    got = hashlib.sha256(data).hexdigest()
    if got != want:
        raise ArtifactError(f"{path}: SHA-256: expected {want[:12]}... of the manifest, got {got[:12]}...")
    return data


def onnx_network(model: bytes, path: Path, manifest: Manifest) -> Network:
    """ONNX Runtime on one thread that never spins, with input and output bound once: 11 us instead of 23 a call."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except _LOAD_ERRORS as error:
        raise ArtifactError(f"{path}: expected an ONNX model: {str(error).splitlines()[0]}") from None
    signature = [(x.name, x.type, x.shape[1:]) for x in (*session.get_inputs(), *session.get_outputs())]
    want = [("observation", "tensor(float)", [6]), ("action", "tensor(float)", [3])]
    if signature != want:
        raise ArtifactError(f"{path}: signature: expected {want}, got {signature}")
    x, y = np.zeros((1, 6), dtype=np.float32), np.zeros((1, 3), dtype=np.float32)
    binding = session.io_binding()
    binding.bind_input("observation", "cpu", 0, np.float32, (1, 6), x.ctypes.data)
    binding.bind_output("action", "cpu", 0, np.float32, (1, 3), y.ctypes.data)

    def infer(observation: Float32) -> Float32:
        x[:] = observation
        session.run_with_iobinding(binding)
        return y

    return infer
