"""What every bench says about itself: one JSON object with machine, commit and figures against their limits."""

from __future__ import annotations

import os
import platform
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion import __version__

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured value and the limit that it is held to, ``"at most"`` or ``"at least"``."""

    name: str
    value: float
    relation: str
    limit: float

    @property
    def met(self) -> bool:
        return self.value <= self.limit if self.relation == "at most" else self.value >= self.limit


def envelope(bench: str, results: dict[str, Any], figures: list[Figure]) -> dict[str, Any]:
    """The JSON object of a bench."""
    return {
        "bench": bench,
        "schema": SCHEMA,
        "version": __version__,
        "commit": _commit(),
        "machine": _machine(),
        "figures": [{**asdict(figure), "met": figure.met} for figure in figures],
        "results": results,
    }


def _machine() -> dict[str, Any]:
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),  # above the cores, tails of time are the scheduler's
        "python": platform.python_version(),
        "numpy": np.__version__,
        "system": platform.platform(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def _commit() -> str | None:
    """Of the checkout that this package is imported from, None where it is installed without one or without git."""
    try:
        done = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError:
        return None
    return done.stdout.strip() or None
