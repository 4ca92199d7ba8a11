"""Reads what `mutmut run` left in mutants/, prints the share of killed mutants, lists the survivors with their diffs.

A mutant counts as killed if a test failed or ran out of time. Everything else survives: no test, a suspicious end, and
every line that was kept from mutation by a pragma. Functions with a decorator other than classmethod and staticmethod
cannot be mutated by mutmut; they are counted, and reviewed by hand (README.md).
"""

from __future__ import annotations

import argparse
import ast
import json
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.stats import status_by_exit_code

PRAGMA = "pragma: no mutate"
MUTABLE_DECORATORS = ("classmethod", "staticmethod")
KILLED, TIMEOUT = "killed", "timeout"


@dataclass(frozen=True, slots=True)
class Tally:
    """One source file's mutants."""

    source: Path
    status: dict[str, str]  # by mutant
    pragmas: int  # lines kept from mutation
    fixed: int  # functions that mutmut cannot mutate

    @property
    def total(self) -> int:
        return len(self.status) + self.pragmas

    @property
    def killed(self) -> int:
        return sum(status in (KILLED, TIMEOUT) for status in self.status.values())

    @property
    def survivors(self) -> list[str]:
        return [name for name, status in self.status.items() if status not in (KILLED, TIMEOUT)]

    def line(self) -> str:
        count = Counter(self.status.values())
        other = len(self.status) - count[KILLED] - count[TIMEOUT] - count["survived"]
        numbers = (self.total, count[KILLED], count[TIMEOUT], count["survived"], other, self.pragmas, self.fixed)
        return (
            f"{self.source!s:32}" + "".join(f"{number:10}" for number in numbers) + percentage(self.killed, self.total)
        )


def percentage(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:9.1f} %" if whole else f"{'-':>9}  "


def fixed_functions(code: str) -> int:
    """Functions with a decorator that mutmut leaves alone."""
    functions = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    return sum(
        any(not (isinstance(mark, ast.Name) and mark.id in MUTABLE_DECORATORS) for mark in function.decorator_list)
        for function in functions
    )


def tally(meta: Path, root: Path) -> Tally:
    """What one mutants/**/*.py.meta says."""
    source = meta.relative_to(root).with_suffix("")
    code = source.read_text(encoding="utf-8")
    exits = json.loads(meta.read_text(encoding="utf-8"))["exit_code_by_key"]
    status = {name: str(status_by_exit_code[code]) for name, code in exits.items()}
    return Tally(source, status, sum(PRAGMA in line for line in code.splitlines()), fixed_functions(code))


def write_survivors(tallies: list[Tally], path: Path) -> None:
    """Each survivor with its status and its diff; of lines kept from mutation the text."""
    with path.open("w", encoding="utf-8") as file:
        for one in tallies:
            for name in one.survivors:
                file.write(f"# {name}: {one.status[name]}\n{get_diff_for_mutant(name, path=one.source)}\n\n")
            for number, line in enumerate(one.source.read_text(encoding="utf-8").splitlines(), start=1):
                if PRAGMA in line:
                    file.write(f"# {one.source}:{number}: kept from mutation\n{line}\n\n")


def main() -> int:
    parser = argparse.ArgumentParser(description="Report what `mutmut run` has found; run it where mutmut ran.")
    parser.add_argument("--root", type=Path, default=Path("mutants"), help="where mutmut works (default: mutants)")
    parser.add_argument("--least", type=float, default=90.0, help="least share killed, in per cent (default: 90)")
    arguments = parser.parse_args()
    tallies = [tally(meta, arguments.root) for meta in sorted(arguments.root.rglob("*.py.meta"))]
    tallies = [one for one in tallies if one.status or one.pragmas]
    total, killed = sum(one.total for one in tallies), sum(one.killed for one in tallies)
    if not total:
        print(f"no results in {arguments.root}: run mutmut first", file=sys.stderr)
        return 2
    titles = ("mutants", "killed", "timeout", "survived", "other", "pragma", "skipped")
    print(f"{'':32}" + "".join(f"{title:>10}" for title in titles))
    for one in tallies:
        print(one.line())
    print(f"killed {killed} of {total}:{percentage(killed, total)} (timeouts count as killed)")
    survivors = arguments.root / "survivors.txt"
    write_survivors(tallies, survivors)
    print(f"survivors: {survivors}")
    return 0 if killed >= arguments.least / 100.0 * total else 1


if __name__ == "__main__":
    sys.exit(main())
