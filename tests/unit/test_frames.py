"""Frames against hand cases and SciPy's rotations."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import companion
from companion import frames

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])


def matrix(q_wxyz: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(q_wxyz, -1)).as_matrix()


def test_north_east_down() -> None:
    assert frames.enu_from_ned([1.0, 0.0, 0.0]).tolist() == [0.0, 1.0, 0.0]
    assert frames.enu_from_ned([0.0, 1.0, 0.0]).tolist() == [1.0, 0.0, 0.0]
    assert frames.enu_from_ned([0.0, 0.0, 1.0]).tolist() == [0.0, 0.0, -1.0]


def test_attitude_against_scipy() -> None:
    rng = np.random.default_rng(1)
    for rotation in Rotation.random(50, rng=rng):
        q_ned_from_frd = np.roll(rotation.as_quat(), 1)
        expected = ENU_FROM_NED @ rotation.as_matrix() @ FRD_FROM_FLU
        np.testing.assert_allclose(matrix(frames.q_enu_from_flu(q_ned_from_frd)), expected, atol=1e-12)


@pytest.mark.parametrize(("yaw_ned_deg", "yaw_enu_deg"), [(0, 90), (90, 0), (180, -90), (-90, 180), (45, 45)])
def test_heading(yaw_ned_deg: float, yaw_enu_deg: float) -> None:
    half = np.radians(yaw_ned_deg) / 2.0
    nose = frames.rotate(frames.q_enu_from_flu([np.cos(half), 0.0, 0.0, np.sin(half)]), [1.0, 0.0, 0.0])
    difference = (np.degrees(np.arctan2(nose[1], nose[0])) - yaw_enu_deg + 180.0) % 360.0 - 180.0
    assert abs(difference) < 1e-9


def test_rotate_and_multiply_against_scipy() -> None:
    rng = np.random.default_rng(2)
    a, b = Rotation.random(rng=rng), Rotation.random(rng=rng)
    qa, qb, v = np.roll(a.as_quat(), 1), np.roll(b.as_quat(), 1), rng.normal(size=3)
    np.testing.assert_allclose(frames.rotate(qa, v), a.apply(v), atol=1e-12)
    np.testing.assert_allclose(matrix(frames.multiply(qa, qb)), (a * b).as_matrix(), atol=1e-12)


def test_covariance_rotates_with_its_axes() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    block = np.kron(np.eye(2), ENU_FROM_NED)
    np.testing.assert_allclose(
        frames.enu_covariance_from_ned(root @ root.T), block @ root @ root.T @ block.T, atol=1e-12
    )


@pytest.mark.parametrize(
    "name", [m.name for m in pkgutil.walk_packages(companion.__path__, "companion.") if "torch" not in m.name]
)
def test_docstring_examples_are_true(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0
