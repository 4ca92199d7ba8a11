"""`python -m docgen`: make the reference anew; with ``--check`` only say what is stale (exit status 1)."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from companion import tunables
from companion.link.keys import key_page
from companion.prometheus import metrics_page
from docgen import commands, configuration, mavlink, pages, scenarios, states

DOCS = Path(__file__).parents[2] / "docs"
MAKERS: dict[str, pages.Maker] = {
    "configuration": configuration.page,
    "presets": configuration.presets,
    "parameters": tunables.reference,
    "mavlink-read": mavlink.read,
    "mavlink-written": mavlink.written,
    "mavlink-commands": mavlink.commands,
    "transitions": states.transitions,
    "events": states.events,
    "verdicts": states.verdicts,
    "profiles": states.profiles,
    "scenario-tables": scenarios.tables,
    "scenario-list": scenarios.shipped,
    **{f"commands-{name}": partial(commands.page, name) for name in commands.PARSERS},
}
WHOLE: dict[str, pages.Maker] = {"reference/keys.md": key_page, "reference/metrics.md": metrics_page}


def main(argv: list[str] | None = None) -> int:
    """Write what is stale, or only name it."""
    parser = argparse.ArgumentParser(prog="python -m docgen", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if a page is stale")
    arguments = parser.parse_args(argv)
    found = pages.stale(DOCS, MAKERS, WHOLE)
    for path, text in found.items():
        print(path.relative_to(DOCS.parent), file=sys.stderr)
        if not arguments.check:
            path.write_text(text, encoding="utf-8")
    return 1 if found and arguments.check else 0


if __name__ == "__main__":
    sys.exit(main())
