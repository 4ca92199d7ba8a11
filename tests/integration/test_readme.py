"""The examples of the README, as printed there, run."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from sim_bridge.testing import FlyingPair

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def example(name: str) -> str:
    match = re.search(rf"<!-- example: {name} -->\n```python\n(.*?)```", README, re.DOTALL)
    assert match is not None, f"README.md: no example {name}"
    return match[1]


@pytest.mark.parametrize(("name", "most"), [("publish", 15), ("fixture", 15), ("library", 10)])
def test_examples_are_short(name: str, most: int) -> None:
    assert len([line for line in example(name).splitlines() if line.strip()]) <= most


def test_library_example() -> None:
    done = subprocess.run([sys.executable, "-c", example("library")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("adjusted")


@pytest.mark.integration
def test_publish_example_is_tracked(flying_pair: Callable[..., FlyingPair]) -> None:
    pair = flying_pair()
    code = example("publish")
    assert "tcp/127.0.0.1:7447" in code
    namespace: dict[str, object] = {}
    thread = threading.Thread(target=exec, args=(code.replace("tcp/127.0.0.1:7447", pair.daemon_endpoint), namespace))
    thread.start()
    try:
        assert pair.wait_status(lambda status: status["tracks"] == 1)
    finally:
        thread.join()


@pytest.mark.integration
def test_fixture_example(flying_pair: Callable[..., FlyingPair]) -> None:
    namespace: dict[str, Callable[..., None]] = {}
    exec(example("fixture"), namespace)
    (test,) = [value for name, value in namespace.items() if name.startswith("test_")]
    test(flying_pair)


COMMANDS = re.findall(r"^    (companion .*?)(?:\s+#.*)?$", README, re.MULTILINE)


def test_the_readme_has_commands() -> None:
    assert len(COMMANDS) >= 3


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_parse(command: str) -> None:
    """Every command line of the README is one that the parser accepts."""
    from companion.cli import build_parser

    assert build_parser().parse_args(shlex.split(command)[1:]).handler is not None


def test_named_files_exist() -> None:
    for path in re.findall(r"(?:configs|docs)/[\w/.-]+\.\w+", README):
        assert (ROOT / path).is_file(), path
