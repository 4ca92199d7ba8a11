"""The fenced blocks of the documentation, and what the comments before them say about running them.

A page is a session: its blocks run from the top to the bottom in one folder of their own. A comment on the line before
a block says what is not plain:

    <!-- file: NAME -->          the block is the content of a file of that name
    <!-- until: TEXT -->         the last command goes on beside the others, to the end; TEXT says that it is up
    <!-- beside: REASON -->      the same for a command that says nothing when it is up
    <!-- exit: N or M -->        the last command ends with such a status instead of 0
    <!-- slow: REASON -->        run only among the slow tests
    <!-- not run: REASON -->     needs what a test has not: hardware, firmware, root, a container engine

Blocks of `sh` and `python` run; `toml`, `json` and the like are content, of a file or to look at; `text` is output.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
RUN = ("sh", "python")
SHOWN = ("toml", "json", "json5", "text", "yaml", "ini", "csv")
DIRECTIVES = ("file", "until", "beside", "exit", "slow", "not run")
PROGRAMS = ("companion", "sim-bridge", "policies")
NO_PAGES = ("CHANGELOG.md", "mutants", "tests")

_BLOCK = re.compile(
    r"(?P<before>(?:^<!-- [^\n]* -->\n)*)^```(?P<language>[\w-]*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
_DIRECTIVE = re.compile(rf"<!-- ({'|'.join(DIRECTIVES)}): (.*?) -->")
_INLINE = re.compile(rf"`((?:{'|'.join(PROGRAMS)}) [^`]+)`")


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block of a page."""

    page: str
    line: int
    language: str
    text: str
    says: dict[str, str] = field(default_factory=dict)

    @property
    def runs(self) -> bool:
        return self.language in RUN and "not run" not in self.says and "file" not in self.says

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def pages() -> list[Path]:
    """Every page of the documentation."""
    found = [path for path in ROOT.rglob("*.md") if not {*path.relative_to(ROOT).parts} & {*NO_PAGES}]
    return sorted(path for path in found if not any(part.startswith(".") for part in path.relative_to(ROOT).parts))


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = text_of(page)
    name = str(page.relative_to(ROOT))
    return [
        Block(
            name,
            text.count("\n", 0, match.start("language")) + 1,
            match["language"],
            match["text"],
            dict(_DIRECTIVE.findall(match["before"])),
        )
        for match in _BLOCK.finditer(text)
    ]


def commands(block: Block) -> list[str]:
    """The lines of a shell block that begin with a program of ours, continuations joined, comments gone."""
    joined = block.text.replace("\\\n", " ")
    lines = [re.sub(r"\s+#\s.*$", "", line).strip() for line in joined.splitlines()]
    return [part.strip() for line in lines for part in line.split("&&") if part.strip().startswith(PROGRAMS)]


def inline_commands(page: Path) -> list[str]:
    """Commands in the running text, as `companion doctor -c FILE`."""
    return _INLINE.findall(re.sub(r"^```.*?^```$", "", text_of(page), flags=re.MULTILINE | re.DOTALL))
