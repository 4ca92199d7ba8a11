"""Pages with parts that code makes: prose stays as it was written, what stands between two markers is made anew.

<!-- made by: NAME -->
...
<!-- end of NAME -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

Maker = Callable[[], str]
_PART = re.compile(r"(<!-- made by: (?P<name>[\w-]+) -->\n).*?(<!-- end of (?P=name) -->)", re.DOTALL)


class UnknownPart(ValueError):
    """A page asks for a part that nothing makes."""


def parts_of(text: str) -> list[str]:
    """Names of the parts of a page, in order."""
    return [match["name"] for match in _PART.finditer(text)]


def remade(text: str, makers: Mapping[str, Maker]) -> str:
    """``text`` with every part as the code makes it now.

    Raises:
        UnknownPart: a marker names none of ``makers``.

    >>> remade("a <!-- made by: x -->\\nold<!-- end of x --> b", {"x": lambda: "new"})
    'a <!-- made by: x -->\\n\\nnew\\n\\n<!-- end of x --> b'
    """

    def part(match: re.Match[str]) -> str:
        if match["name"] not in makers:
            raise UnknownPart(f"{match['name']}: expected one of {', '.join(sorted(makers))}")
        return f"{match[1]}\n{makers[match['name']]().strip()}\n\n{match[3]}"

    return _PART.sub(part, text)


def table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """A Markdown table; a bar within a cell is escaped."""
    lines = [header, tuple("---" for _ in header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def stale(folder: Path, makers: Mapping[str, Maker], whole: Mapping[str, Maker]) -> dict[Path, str]:
    """The pages below ``folder`` that differ from what the code makes, with their new text.

    ``whole``: pages that are made entirely, by their path below ``folder``.
    """
    wanted = {folder / name: make() for name, make in whole.items()}
    for path in sorted(folder.rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        if path not in wanted and parts_of(text):
            wanted[path] = remade(text, makers)
    return {path: new for path, new in wanted.items() if not path.is_file() or path.read_text(encoding="utf-8") != new}
