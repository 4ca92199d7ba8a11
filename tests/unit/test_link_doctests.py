"""The examples in the docstrings of the link modules are true."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize("name", ["link.mav", "link.mavlink", "link.timesync", "link.url", "notices", "publish"])
def test_docstring_examples(name: str) -> None:
    outcome = doctest.testmod(importlib.import_module(f"companion.{name}"))
    assert outcome.attempted > 0
    assert outcome.failed == 0
