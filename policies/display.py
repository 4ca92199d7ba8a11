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
