"""The reference pages are what the code makes (`make docs`), and no key of the configuration goes unexplained."""

from __future__ import annotations

import re

import pytest
from docgen import __main__ as docgen
from docgen import configuration, mavlink, pages
from docgen.commands import PARSERS
from docgen.commands import commands as parsers


def test_no_page_is_stale() -> None:
    found = [str(path) for path in pages.stale(docgen.DOCS, docgen.MAKERS, docgen.WHOLE)]
    assert not found, "run `make docs`"


def test_every_part_is_used() -> None:
    used = [name for page in docgen.DOCS.rglob("*.md") for name in pages.parts_of(page.read_text(encoding="utf-8"))]
    assert sorted(used) == sorted(docgen.MAKERS)


def test_every_key_means_something() -> None:
    assert not [key for key, meaning in configuration.meanings().items() if not meaning]


def test_a_changed_default_makes_the_page_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configuration, "comments", lambda text: {"safety.kappa": "something else"})
    found = pages.stale(docgen.DOCS, docgen.MAKERS, docgen.WHOLE)
    assert [path.name for path in found] == ["configuration.md"]


def test_a_message_of_which_nothing_is_said_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(mavlink.READ, "TIMESYNC")
    with pytest.raises(ValueError, match=r"nothing is said of \['TIMESYNC'\]"):
        mavlink.read()


def test_an_unknown_part_is_an_error() -> None:
    with pytest.raises(pages.UnknownPart, match="expected one of a"):
        pages.remade("<!-- made by: b -->\n<!-- end of b -->", {"a": str})


@pytest.mark.parametrize("program", PARSERS)
def test_every_command_is_on_its_page(program: str) -> None:
    text = (docgen.DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    for parser, _ in parsers(PARSERS[program]()):
        assert f"### `{parser.prog}`\n" in text
        section = text.split(f"### `{parser.prog}`\n")[1].split("\n### ")[0]
        options = {option for action in parser._actions for option in action.option_strings} - {"-h", "--help"}
        assert options <= set(re.findall(r"`(--?[\w-]+)", section))
