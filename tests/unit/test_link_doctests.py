"""The examples in the docstrings of the link modules are true."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize(
    "name",
    ["link.mavlink", "link.timesync", "link.url", "publish", "doctor.command", "doctor.observation", "doctor.verdict"],
)
def test_docstring_examples(name: str) -> None:
    outcome = doctest.testmod(importlib.import_module(f"companion.{name}"))
    assert outcome.attempted > 0
    assert outcome.failed == 0
