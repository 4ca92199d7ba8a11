"""Every shipped scenario, flown with the real daemon in lockstep: what it expects must be seen.

Two flights at a time: the simulator and the daemon of one wait for each other, so two of them fill two cores.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "configs" / "scenarios"
SCENARIOS = sorted(path.stem for path in FOLDER.glob("*.toml"))
FLIGHTS_AT_A_TIME = 2
LIMIT_S = 60.0

pytestmark = pytest.mark.integration

Done = subprocess.CompletedProcess[str]


def fly(name: str, *more: str) -> Done:
    words = [sys.executable, "-m", "sim_bridge.cli", "run", "--scenario", name, "--check", "--json", *more]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(words, capture_output=True, text=True, timeout=LIMIT_S, check=False, env=one_thread)


@pytest.fixture(scope="module")
def flights(request: pytest.FixtureRequest) -> Iterator[dict[str, Future[Done]]]:
    """The flights of this run's tests, in their order, each begun before its test asks for it."""
    wanted = [item.callspec.params["name"] for item in request.session.items if item.path == request.path]
    with ThreadPoolExecutor(FLIGHTS_AT_A_TIME) as pool:
        started = {name: pool.submit(fly, name) for name in wanted}
        yield started
        for flight in started.values():
            flight.cancel()


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_scenario_shows_what_it_expects(name: str, flights: dict[str, Future[Done]]) -> None:
    done = flights[name].result()
    assert done.returncode in (0, 1), done.stderr
    assert done.stdout, done.stderr
    report = json.loads(done.stdout)
    failed = [
        f"{f['vehicle']} {f['about']}: expected {f['expected']}: {f['seen']}"
        for f in report["expectations"]
        if not f["met"]
    ]
    assert report["expectations"], "a scenario that expects nothing shows nothing"
    assert not failed, "\n".join([f"{name}, seed {report['flight']['seed']}:", *failed])
    assert done.returncode == 0
