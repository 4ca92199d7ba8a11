"""The examples in the docstrings are true."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize(
    "name",
    [
        "doctor.command",
        "doctor.observation",
        "doctor.verdict",
        "hostload",
        "link.identity",
        "link.mav",
        "link.mavlink",
        "link.ros2",
        "link.routes",
        "link.signing",
        "link.timesync",
        "link.url",
        "notices",
        "publish",
        "tunables",
    ],
)
def test_docstring_examples(name: str) -> None:
    outcome = doctest.testmod(importlib.import_module(f"companion.{name}"))
    assert outcome.attempted > 0
    assert outcome.failed == 0
