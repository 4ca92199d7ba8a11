"""Progress of a training on the terminal (standard error, so that --json keeps standard output)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

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
