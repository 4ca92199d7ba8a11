"""Every command of the documentation runs as printed; what cannot run here says why."""

from __future__ import annotations

import ast
import json
import re
import shlex
import sys
import tomllib
import types
from collections.abc import Iterator
from pathlib import Path

import pytest
from docgen.commands import PARSERS
from docgen.commands import commands as parsers
from docs_blocks import RUN, SHOWN, Block, blocks, commands, inline_commands, pages
from docs_session import ROOT, Session

from companion.link.ingress import detections_from_frame
from companion.link.wire import Obstacle, ObstacleFrame, decode

PAGES = {str(page.relative_to(ROOT)): blocks(page) for page in pages()}
ALL = [block for found in PAGES.values() for block in found]
EXAMPLES = "docs/reference/commands.md"  # the commands of every --help: long ones too, so they are parsed, not run
TO_RUN = {name: found for name, found in PAGES.items() if name != EXAMPLES and any(block.runs for block in found)}
SLOW = [name for name, found in TO_RUN.items() if any("slow" in block.says for block in found)]
FAST = [name for name, found in TO_RUN.items() if any(block.runs and "slow" not in block.says for block in found)]
KNOWN = {" ".join(parser.prog.split()): parser for build in PARSERS.values() for parser, _ in parsers(build())}


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    session = Session(tmp_path)
    try:
        yield session
    finally:
        session.close()


@pytest.mark.integration
@pytest.mark.parametrize("page", FAST)
def test_a_page_runs_from_top_to_bottom(page: str, session: Session) -> None:
    for block in PAGES[page]:
        if "slow" not in block.says:
            session.do(block)


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", SLOW)
def test_a_page_runs_with_what_takes_long(page: str, session: Session) -> None:
    for block in PAGES[page]:
        session.do(block)


@pytest.mark.parametrize("block", ALL, ids=str)
def test_a_block_is_what_it_says(block: Block, tmp_path: Path) -> None:
    """Its language is one of those that are run or shown, what it holds can be read, its directives are meant."""
    assert block.language in (*RUN, *SHOWN), f"{block}: expected ```sh, ```python or one of {SHOWN}"
    if block.language == "python":
        ast.parse(block.text)
    if block.language == "toml":
        tomllib.loads(block.text)
    if block.language == "json":
        json.loads(block.text)
    if {"until", "beside", "exit", "slow"} & set(block.says):
        assert block.runs
    assert all(block.says.values()), f"{block}: expected a reason"


@pytest.mark.parametrize("block", [b for b in ALL if b.language == "sh"], ids=str)
def test_the_commands_of_a_block_parse(block: Block) -> None:
    """Also of those blocks that do not run here: every option is one that the program has."""
    for command in commands(block):
        words = shlex.split(re.split(r" [|>&]", command)[0])
        build = PARSERS[words[0]]
        if {"--help", "--version", "-h"} & {*words}:
            continue
        assert build().parse_args(words[1:]), command


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_the_text_exist(page: str) -> None:
    """Of `companion doctor -c FILE` in a sentence: the command, and each option."""
    for command in inline_commands(ROOT / page):
        words = re.split(r"[\s=]+", command)
        name = next((n for n in (" ".join(words[:k]) for k in (3, 2)) if n in KNOWN), None)
        group = any(known.startswith(" ".join(words[:2]) + " ") for known in KNOWN)
        assert name or group or words[1].startswith("-") or "|" in words[1], f"{page}: {command}"
        if name:
            options = {option for action in KNOWN[name]._actions for option in action.option_strings}
            used = {word.rstrip(",.;") for word in words if re.match(r"--?[a-z]", word)}
            assert used <= options, f"{page}: {command}: {used - options}"


def test_no_command_hides_outside_of_a_fence() -> None:
    """Indented blocks are not seen by the tests above."""
    for page in pages():
        bare = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        hidden = re.findall(
            r"^ {4,}(?:companion|sim-bridge|policies|make|pip|python3?|import|from) .*$", bare, re.MULTILINE
        )
        assert not hidden, f"{page.name}: {hidden}"


def test_what_is_not_run_is_known() -> None:
    """The reasons for which blocks are left out, so that a new one is seen in review."""
    reasons = {re.split(r"[:,;(]", block.says["not run"])[0].strip() for block in ALL if "not run" in block.says}
    assert reasons <= REASONS, f"expected one of REASONS, got {reasons - REASONS}"
    left_out = sum("not run" in block.says for block in ALL)
    assert left_out < sum(block.runs for block in ALL), "more is left out than is run"


def test_frames_of_the_examples_are_ones_that_the_daemon_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every example that publishes, as many frames as it likes; a wrong field would be refused and never seen."""
    examples = [block for block in ALL if block.language == "python" and "declare_publisher" in block.text]
    assert len(examples) >= 2
    for block in examples:
        published: list[tuple[str, str]] = []
        monkeypatch.setitem(sys.modules, "zenoh", _Zenoh(published))
        monkeypatch.setattr("time.sleep", lambda seconds: None)
        exec(compile(block.text, str(block), "exec"), {})
        assert published, block
        for key, payload in published:
            assert key.startswith("uav/uav1/obstacles/")
            frame = decode(payload.encode(), ObstacleFrame)
            taken = detections_from_frame(
                frame, source="s", sequence=0, now_ns=frame.stamp_ns, unix_minus_vehicle_ns=0, max_age_s=0.5
            )
            assert set(json.loads(payload)) <= {*ObstacleFrame.__struct_fields__}
            assert {key for each in json.loads(payload)["obstacles"] for key in each} <= {*Obstacle.__struct_fields__}
            assert taken.detections


class _Zenoh(types.ModuleType):
    """Stands for the module: one session, one publisher, which notes what is put."""

    def __init__(self, published: list[tuple[str, str]]) -> None:
        super().__init__("zenoh")
        self._published, self._key = published, ""
        self.Config = self.open = lambda *_: self

    def insert_json5(self, key: str, value: str) -> None:
        json.loads(value)

    def declare_publisher(self, key: str) -> _Zenoh:
        self._key = key
        return self

    def put(self, payload: str) -> None:
        self._published.append((self._key, payload))

    def __enter__(self) -> _Zenoh:
        return self

    def __exit__(self, *exc: object) -> None:
        pass


REASONS = {
    "needs the network",
    "needs PX4",
    "needs ArduPilot",
    "needs ROS 2",
    "needs a vehicle",
    "needs root",
    "needs a container engine",
    "needs a ground station",
    "takes minutes",
    "run by tests/integration/test_security_page.py",
}
