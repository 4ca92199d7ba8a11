"""Print what this project depends on, one requirement a line: `python requirements.py [EXTRA ...]`.

The images install it in a layer of its own, which a change of the source does not rebuild. The extras of
pyproject.toml are named on the command line; run where pyproject.toml lies.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path


def requirements(pyproject: Path, extras: list[str]) -> list[str]:
    """The requirements of the project and of ``extras``. Raises KeyError for an extra that it does not have."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    return [*project["dependencies"], *(line for extra in extras for line in optional[extra])]


if __name__ == "__main__":
    print("\n".join(requirements(Path("pyproject.toml"), sys.argv[1:])))
