"""Progress on the terminal (standard error, so that --json keeps standard output)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from policies.evaluation.encounters import Outcome

if TYPE_CHECKING:  # imports torch, which encounters do without
    from policies.train import CurvePoint


@contextmanager
def training_display(steps: int) -> Iterator[Callable[[CurvePoint], None]]:
    """A bar with the mean return and the share of episodes that reached the target."""
    columns = (
        TextColumn("train"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} steps"),
        TextColumn("return {task.fields[mean_return]:.1f}  reached {task.fields[success]:.1%}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("train", total=steps, mean_return=float("nan"), success=0.0)

        def show(point: CurvePoint) -> None:
            progress.update(task, completed=point.steps, mean_return=point.mean_return, success=point.success)

        yield show


@contextmanager
def work_display() -> Iterator[Callable[[str, float], None]]:
    """A bar for one piece of work after another; nothing where standard error is not a terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not console.file.isatty()) as progress:
        task = progress.add_task("", total=1.0)

        def show(what: str, share: float) -> None:
            progress.update(task, description=what, completed=share)

        yield show


@contextmanager
def flights_display(what: str, flights: int, *, shown: bool) -> Iterator[Callable[[], None]]:
    """A bar that counts flights; nothing where it is not to be shown or standard error is not a terminal."""
    columns = (
        TextColumn(what),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not (shown and console.file.isatty())) as progress:
        task = progress.add_task(what, total=flights)
        yield lambda: progress.advance(task)


@contextmanager
def encounters_display(flights: int) -> Iterator[Callable[[Outcome], None]]:
    """A bar with the collisions so far; nothing where standard error is not a terminal."""
    columns = (
        TextColumn("encounters"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} flights  {task.fields[collisions]} collided"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.file.isatty()) as progress:
        task = progress.add_task("encounters", total=flights, collisions=0)
        collisions = 0

        def show(outcome: Outcome) -> None:
            nonlocal collisions
            collisions += outcome.collided
            progress.update(task, advance=1, collisions=collisions)

        yield show
