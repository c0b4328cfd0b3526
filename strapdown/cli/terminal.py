"""What every command shares: the application, the two consoles, tables and progress."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

app = typer.Typer(
    help="Strapdown gyro attitude estimation: simulate, estimate, judge.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
# Without markup, so that a file name in brackets is said as it is.
console = Console(markup=False, highlight=False)
errors = Console(stderr=True, markup=False, highlight=False)


def rate_text(speed: float) -> str:
    """Return a rate in three digits or whole ones."""
    return f"{speed:.0f}" if speed >= 100.0 else f"{speed:.3g}"


class _Rate(ProgressColumn):
    """Units a second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Return the rate of the last while, or of the whole where it is finished."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{rate_text(speed)} {self._unit}")


@contextmanager
def progress_bar(what: str, total: int, *, rate: str = "") -> Iterator[Any]:
    """Yield a function that advances a bar by so many units; on standard error, and only on a terminal.

    With ``rate``, its unit, the bar tells how many units a second are done.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        *([_Rate(rate)] if rate else []),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.advance(task, done)


def table(title: str, *columns: str, left: int = 1) -> Table:
    """Print the title and return an empty table, its first ``left`` columns text and the others numbers.

    The title stands outside because one longer than its table would wrap inside it.
    """
    console.print(Text(title, style="bold"))
    result = Table(box=box.SIMPLE_HEAD, header_style="", pad_edge=False, padding=(0, 1, 0, 0))
    for k, column in enumerate(columns):
        result.add_column(column, justify="left" if k < left else "right", no_wrap=k > 0 or left == 1)
    return result


def show(rows: Table) -> None:
    """Print a table whole: on a narrow terminal its lines run over rather than lose their ends."""
    width, console.width = console.width, 1000
    try:
        console.print(rows, crop=False)
    finally:
        console.width = width


def verdict(good: bool) -> Text:
    """Return "pass" or "FAIL", coloured where the terminal can."""
    return Text("pass", style="green") if good else Text("FAIL", style="red")


def written(*paths: Any) -> None:
    """Say which files were written."""
    console.print("Written: " + ", ".join(str(path) for path in paths), soft_wrap=True)
