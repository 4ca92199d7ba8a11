"""docs/reference/keys.md is what the code prints, and what the code prints is what the daemon declares."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.cli import main
from companion.link import keys, wire
from companion.link.zenoh import ZenohHandlers, ZenohLink

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "keys.md"


class Session:
    """Stands for a Zenoh session and notes what is declared."""

    def __init__(self) -> None:
        self.declared: dict[str, list[tuple[str, dict[str, Any]]]] = {}

    def _note(self, kind: str, key: str, settings: dict[str, Any]) -> None:
        self.declared.setdefault(kind, []).append((key.removeprefix("uav/x/"), settings))

    def declare_publisher(self, key: str, **settings: Any) -> None:
        self._note("publisher", key, settings)

    def declare_subscriber(self, key: str, _handler: object) -> None:
        self._note("subscriber", key, {})

    def declare_queryable(self, key: str, _handler: object) -> None:
        self._note("queryable", key, {})

    def liveliness(self) -> Session:
        return self

    def declare_token(self, key: str) -> None:
        self._note("token", key, {})


def declared(*, lockstep: bool) -> dict[str, list[tuple[str, dict[str, Any]]]]:
    session = Session()
    handlers = ZenohHandlers(
        on_obstacles=lambda *_: None,
        on_target=lambda _: wire.Reply(accepted=True),
        on_engage=lambda _: wire.Reply(accepted=True),
        config=bytes,
        health=bytes,
        on_marker=lambda *_: None,
        on_vehicle=lambda *_: None,
    )
    loop = asyncio.new_event_loop()
    ZenohLink(session, "uav/x", loop, handlers)._declare(lockstep)  # type: ignore[arg-type]
    loop.close()
    return session.declared


def rows(heading: str) -> list[list[str]]:
    """The cells of the table below a heading of the page."""
    section = PAGE.read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]
    table = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in table]


def test_the_page_is_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", "--keys"]) == 0
    assert capsys.readouterr().out == PAGE.read_text(encoding="utf-8"), (
        "companion schema --keys > docs/reference/keys.md"
    )


@pytest.mark.parametrize("lockstep", [False, True])
def test_the_outlets_are_declared_as_documented(lockstep: bool) -> None:
    written = {row[0]: row for row in rows("The daemon writes") if row[1] != "liveliness token"}
    made = dict(declared(lockstep=lockstep)["publisher"])
    assert set(made) == set(written)
    for key, settings in made.items():
        row = written[key]
        assert settings["congestion_control"] == getattr(zenoh.CongestionControl, row[4 if lockstep else 3])
        assert settings["priority"] == getattr(zenoh.Priority, row[5])
        assert settings["express"] is (row[6] == "yes")
        assert settings["reliability"] == zenoh.Reliability.RELIABLE


def test_every_key_that_is_declared_is_documented_and_the_reverse() -> None:
    made = declared(lockstep=True)
    read = {re.sub(r"\{\w+\}", "*", row[0]) for row in rows("The daemon reads")}
    assert {key for key, _ in made["subscriber"]} == read
    assert {key for key, _ in made["queryable"]} == {row[0] for row in rows("The daemon answers")}
    assert [key for key, _ in made["token"]] == [keys.ALIVE]
    assert set(keys.INLETS) == set(wire.INCOMING)


def test_every_payload_is_described_field_by_field() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for kind in {*wire.INCOMING.values(), *wire.OUTGOING.values()}:
        section = text.split(f"### {kind.__name__}\n")[1].split("### ")[0]
        assert re.findall(r"^\| `(\w+)` \|", section, re.M) == list(kind.__struct_fields__)
