"""Shared by every command: the application, the two consoles, tables."""

from __future__ import annotations

import copy
import dataclasses
import enum
import functools
import inspect
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from strapdown.checks import InputError
from strapdown.cli.progress import errors, progress_bar, rate_text
from strapdown.files import json_text, output_file, usable_folder, write_json

if TYPE_CHECKING:
    from strapdown.recordings import Recording
    from strapdown.results import Listing
    from strapdown.scenarios import Scenario

__all__ = [
    "app",
    "command",
    "console",
    "counted",
    "doubt",
    "errors",
    "gap_words",
    "given",
    "json_target",
    "need_own",
    "progress_bar",
    "put_json",
    "rate_text",
    "scenario_named",
    "show",
    "show_listing",
    "table",
    "verdict",
    "writable",
    "written",
]

LARGEST_NUMBER = 1e30
"""No number of a scenario is larger in any unit that its file may use; beyond it squares and products leave the range of doubles."""
MAX_MEASUREMENTS = 1e8
"""Most measurements of one sensor in a scenario; more do not fit into memory."""

app = typer.Typer(
    help="Strapdown gyro attitude estimation: simulate, estimate, judge.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
# Without markup, so that a file name in brackets is said as it is; a statement is one line, which the terminal wraps.
console = Console(markup=False, highlight=False, soft_wrap=True)


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Register a command. A parameter whose type is a dataclass stands for the options that are its fields, under one heading of --help."""
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if dataclasses.is_dataclass(hint)}
    parameters = []
    for name, parameter in inspect.signature(function).parameters.items():
        if name in groups:
            parameters += _options(groups[name])
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[name]))

    @functools.wraps(function)
    def run(**values: Any) -> None:
        grouped = {
            name: group(**{field.name: values.pop(field.name) for field in dataclasses.fields(group)})
            for name, group in groups.items()
        }
        function(**values, **grouped)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return app.command()(run)


def _options(group: Any) -> list[inspect.Parameter]:
    """Return the fields of a group as parameters, their options the defaults; the first line of its docstring is the heading in --help."""
    hints = get_type_hints(group)
    found = []
    for field in dataclasses.fields(group):
        option: Any = copy.copy(field.default)
        option.rich_help_panel = group.__doc__.partition("\n")[0].rstrip(".")
        kind = inspect.Parameter.KEYWORD_ONLY
        found.append(inspect.Parameter(field.name, kind, default=option, annotation=hints[field.name]))
    return found


def given(group: Any) -> list[str]:
    """Return the options of a group that were given, as on the command line."""
    flags = []
    for field in dataclasses.fields(group):
        option: Any = field.default
        if getattr(group, field.name) not in (option.default, []):
            flag = option.param_decls[0] if option.param_decls else "--" + field.name.replace("_", "-")
            flags.append(flag.partition("/")[0])
    return flags


class FigureFormat(enum.StrEnum):
    """Formats of figures."""

    png = "png"
    pdf = "pdf"
    svg = "svg"


FORMAT: Any = typer.Option(FigureFormat.png, "--format", help="Format of the figures.")
"""Option of every command that draws."""
TABLES: Any = typer.Option(
    None, "--tables", help="Folder to write the tables to as well, as CSV with every digit and as LaTeX."
)
"""Option of every command that prints the tables of a study."""


def counted(number: int, what: str) -> str:
    """Return a number with what it counts, in the plural unless it is one."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def table(title: str, *columns: str, left: int = 1) -> Table:
    """Print the title and return an empty table, its first ``left`` columns text and the others numbers."""
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


def show_listing(listing: Listing, title: str | None = None, *, notes: bool = False) -> None:
    """Show the table of a result, perhaps under another title, and its notes where they are asked for."""
    rows = table(title or listing.title, *listing.columns, left=listing.left)
    styles = {"pass": "green", "FAIL": "red", "likely": "red"}
    for row in listing.rows:
        rows.add_row(*(Text(cell, style=styles.get(cell, "")) for cell in row))
    show(rows)
    for note in listing.notes if notes else ():
        console.print(note)


def tables_written(folder: Path | None, study: str, *results: Any) -> list[Path]:
    """Write the tables of a study to the folder of ``--tables``, if one is given, and return the files."""
    if folder is None:
        return []
    from strapdown.report import tables

    return tables.write(tables.STUDIES[study](*results), folder)


def tables_folder(folder: Path | None) -> None:
    """Refuse a folder of ``--tables`` that cannot be written to, before anything is computed."""
    if folder is not None:
        usable_folder("--tables", folder)


def verdict(good: bool) -> Text:
    """Return "pass" or "FAIL", coloured where the terminal can."""
    return Text("pass", style="green") if good else Text("FAIL", style="red")


def scenario_named(name: str) -> Scenario:
    """Return the scenario of a name or a TOML file whose numbers can be computed with, not only read."""
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
        if measurements > MAX_MEASUREMENTS:
            raise InputError(
                f"{name}: {sensor.name} would measure {measurements:.3g} times, more than {MAX_MEASUREMENTS:.0e}; lower its rate or "
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
    """Refuse files that a command is going to write but cannot, before it computes what goes into them."""
    for target in targets:
        if target.is_dir():
            raise InputError(
                f"{option}: {target} is a folder, and a file of that name is to be written; choose another"
            )
        read = [source for source in sources if source is not None]
        output_file(option, target, suffixes or (target.suffix.lower(),), *read)


def need_own(target: Path, command: str, own: Callable[[Path], bool]) -> None:
    """Refuse to replace a file that the command did not write, of which there may be no other copy; its own it may make again."""
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
    from strapdown.ahrs import check_conventions

    with progress_bar("trying conventions"):
        found = check_conventions.examine(source)
    doubts = found.doubts
    if found.verdict == "wrong convention":
        doubts = (f"as it seems, {found.reason}",)
    for words in doubts:
        console.print(f"warning: {words}. See `strapdown doctor {path}`.")


def gap_words(gaps: Sequence[tuple[float, float]]) -> str:
    """Return how many gaps between stamps there are, begin and length of each given, and the longest; empty without any."""
    if not gaps:
        return ""
    begin, length = max(gaps, key=lambda gap: gap[1])
    return f"Gaps between stamps: {len(gaps)}, the longest {length:.3g} s after {begin:.3f} s"


STANDARD_OUTPUT = Path("-")


def json_target(json: Path | None, *sources: Path | None) -> None:
    """Refuse a file for JSON that cannot be written; "-" is standard output, and what else is printed goes to standard error."""
    if json == STANDARD_OUTPUT:
        console.stderr = True
    elif json is not None:
        writable("json", json, suffixes=(".json",), sources=sources)


def put_json(json: Path | None, content: Any) -> None:
    """Write JSON where it was asked for."""
    if json == STANDARD_OUTPUT:
        sys.stdout.write(json_text(content))
    elif json is not None:
        write_json(json, content)
        written(json)


def written(*paths: Any) -> None:
    """Say which files were written."""
    console.print("Written: " + ", ".join(str(path) for path in paths))
