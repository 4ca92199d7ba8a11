"""What pytest needs for mutmut's many runs in forks of one process (`make mutants` loads it with ``-p``).

1. Each run imports the test modules anew. What a module builds while it is imported would otherwise be what the
   unmutated code of the process before the fork has built, and a mutant would survive unseen.
2. A function called while a module is imported concerns every test of it; mutmut would know only of the first test.
3. Tests of the mutated module run first, before the others are even collected, and quick ones before slow ones: most
   mutants die in the first half second.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from pathlib import Path

import pytest
from mutmut.state import state

TESTS = Path(__file__).parents[1]
_called: dict[str, set[str]] = {}  # by the test module's node id


def own_file() -> str:
    """The test file of the module that has the active mutant, "" without one (stats, clean run)."""
    parts = os.environ.get("MUTANT_UNDER_TEST", "").split(".")
    return f"/test_safety_{parts[2]}.py" if len(parts) > 3 else ""


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> int | pytest.ExitCode | None:
    tests = [argument for argument in config.args if own_file() and own_file() in argument]
    others = [argument for argument in config.args if argument not in tests]
    if not tests or not others:
        return None
    code = pytest.main([argument for argument in config.invocation_params.args if argument not in others])
    config.args = others
    return code or None


def pytest_sessionstart() -> None:
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file and Path(file).name.startswith("test_") and TESTS in Path(file).parents:
            del sys.modules[name]


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    if isinstance(collector, pytest.Module):
        _called[collector.nodeid] = set(state()._stats)
        state()._stats.clear()
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if os.environ.get("MUTANT_UNDER_TEST") == "stats":
        for item in items:
            for function in _called.get(item.nodeid.partition("::")[0], ()):
                state().tests_by_mangled_function_name[function].add(item.nodeid)
    seconds = state().duration_by_test
    items.sort(key=lambda item: (round(seconds.get(item.nodeid, 0.0), 2), item.nodeid))
