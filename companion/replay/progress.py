"""A count of ticks on a terminal while a log is read."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

Advance: TypeAlias = Callable[[], None]  # to be called once a tick


@contextmanager
def progress(what: str, *, quiet: bool) -> Iterator[Advance]:
    """Shows ``what`` and the ticks so far, gone at the end; nothing where standard error is no terminal."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    live = sys.stderr.isatty() and not quiet
    columns = (SpinnerColumn(), TextColumn("{task.description}: {task.completed:.0f} ticks"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not live) as shown:
        task = shown.add_task(what, total=None)
        yield lambda: shown.advance(task)
