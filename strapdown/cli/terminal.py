"""What every command shares: the application, the two consoles, tables and progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from strapdown.recordings import Recording
    from strapdown.scenarios import Scenario

LARGEST_NUMBER = 1e30
"""No number of a scenario is larger in any unit that its file may use; beyond it squares and products leave the range of doubles."""
MOST_MEASUREMENTS = 1e8
"""Of one sensor in a scenario: more do not fit into memory."""

app = typer.Typer(
    help="Strapdown gyro attitude estimation: simulate, estimate, judge.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
# Without markup, so that a file name in brackets is said as it is; a statement is one line, which the terminal wraps.
console = Console(markup=False, highlight=False, soft_wrap=True)
errors = Console(stderr=True, markup=False, highlight=False)


def rate_text(speed: float) -> str:
    """Return a rate in three digits or whole ones."""
    return f"{speed:.0f}" if speed >= 100.0 else f"{speed:.3g}"


def counted(number: int, what: str) -> str:
    """Return a number with what it counts, in the plural unless it is one."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


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


def scenario_named(name: str) -> Scenario:
    """Return the scenario of a name or a TOML file whose numbers can be computed with, not only read.

    Refused are numbers beyond :data:`LARGEST_NUMBER`, a duration shorter than one gyro sample, and more measurements of a sensor than
    :data:`MOST_MEASUREMENTS`: each would end deep inside, as an infinity or for want of memory.
    """
    from strapdown.checks import InputError
    from strapdown.scenarios import load_scenario, scenario_to_table

    chosen = load_scenario(name)
    for key, number in _numbers("", scenario_to_table(chosen)):
        if LARGEST_NUMBER < abs(number) < float("inf"):  # infinite is what never happens, such as a time without end
            raise InputError(f"{name}: {key} is {number:g}, which no such thing can be; check it and its unit")
    if chosen.duration * chosen.rate < 1.0:
        raise InputError(
            f"{name}: {chosen.duration:g} s at {chosen.rate:g} Hz are less than one gyro sample; lengthen the run or raise the rate"
        )
    for sensor in chosen.sensors:
        measurements = chosen.duration * getattr(sensor, "rate", 0.0)
        if measurements > MOST_MEASUREMENTS:
            raise InputError(
                f"{name}: {sensor.name} would measure {measurements:.3g} times, more than {MOST_MEASUREMENTS:.0e}; lower its rate or "
                "shorten the run"
            )
    return chosen


def _numbers(place: str, content: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers in a table of TOML with their places."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _numbers(f"{place}.{key}" if place else key, value)
    elif isinstance(content, list):
        for k, value in enumerate(content):
            yield from _numbers(f"{place}[{k}]", value)
    elif isinstance(content, (int, float)) and not isinstance(content, bool):
        yield place, float(content)


def writable(
    option: str, *targets: Path, suffixes: tuple[str, ...] = (), sources: tuple[Path | str | None, ...] = ()
) -> None:
    """Refuse files that a command is going to write but cannot, before it computes what goes into them.

    A folder of that name stands in the way, the folder that they go to may not be written or lies below a file, the suffix is none of
    ``suffixes`` (where given), or a target is one of the ``sources`` that are read.
    """
    from strapdown.checks import InputError
    from strapdown.files import output_file

    for target in targets:
        if target.is_dir():
            raise InputError(
                f"{option}: {target} is a folder, and a file of that name is to be written; choose another"
            )
        read = [source for source in sources if source is not None]
        output_file(option, target, suffixes or (target.suffix.lower(),), *read)


def need_own(target: Path, command: str, own: Callable[[Path], bool]) -> None:
    """Refuse to replace a file that the command did not write, of which there may be no other copy; its own it may make again."""
    from strapdown.checks import InputError

    try:
        replaceable = not target.exists() or own(target)
    except InputError:
        replaceable = False
    if not replaceable:
        raise InputError(
            f"{target} exists and is not what `strapdown {command}` writes; move it, or choose another --out"
        )


def doubt(source: Recording, path: Path) -> None:
    """Say where a recording seems not to be what it says: of all that is made of it, a wrong unit is the likeliest to be missed."""
    from strapdown import doctor

    found = doctor.examine(source)
    doubts = found.doubts
    if found.verdict == "wrong convention":
        doubts = (f"as it seems, {found.reason}",)
    for words in doubts:
        console.print(f"warning: {words}. See `strapdown doctor {path}`.")


def written(*paths: Any) -> None:
    """Say which files were written."""
    console.print("Written: " + ", ".join(str(path) for path in paths))
