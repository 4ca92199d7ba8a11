"""Which machine a result was computed on, as far as its last bits depend on that."""

from __future__ import annotations

import hashlib
import platform

import numpy as np
from msgspec import Struct


class Machine(Struct, frozen=True, kw_only=True):
    """What decides the last bits of a result besides the program: compare it where a replay differs in those."""

    architecture: str
    python: str
    numpy: str
    simd: str  # instruction sets that numpy found here
    numerics: str  # `numerics_fingerprint` here


def this_machine() -> Machine:
    """The machine at hand."""
    return Machine(
        architecture=platform.machine(),
        python=platform.python_version(),
        numpy=np.__version__,
        simd=" ".join(_simd()),
        numerics=numerics_fingerprint(),
    )


def numerics_fingerprint() -> str:
    """What products, sums and functions of fixed numbers come to here, to the bit: hexadecimal, 16 digits.

    The kernels of BLAS and the vector loops of numpy are chosen by the processor and round differently. Two machines
    of one fingerprint agree in the operations that the brain is made of; two of different ones need not.
    """
    x = np.linspace(0.1, 3.7, 23 * 40).reshape(40, 23)
    square = x[:9, :9] @ x[:9, :9].T + np.eye(9)
    parts = (
        x @ x.T,
        x.T @ x[:, 0],
        x[0, :5] @ x[:5],
        np.stack([x[:9, :9], x[9:18, :9]]) @ square,
        np.exp(-x),
        np.sin(7.0 * x),
        np.cos(x),
        np.log(x),
        np.sqrt(x),
        np.add.reduce(x * x, axis=0),
        np.vecdot(x, x),
        np.linalg.inv(square),
        np.linalg.cholesky(square),
        np.linalg.eigvalsh(square),
        np.einsum("ij,ik->jk", x[:6], x[6:12]),
        np.tanh(x.astype(np.float32)),
    )
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()[:16]


def _simd() -> list[str]:
    found = np.show_config(mode="dicts")
    simd = found.get("SIMD Extensions", {}) if isinstance(found, dict) else {}
    return [str(name) for name in (*simd.get("baseline", ()), *simd.get("found", ()))]
