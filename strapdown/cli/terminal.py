"""Functions shared by all commands: the application, the two consoles, tables."""

from __future__ import annotations

import copy
import dataclasses
import enum
import functools
import inspect
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import rich.table
import typer
from rich import box
from rich.text import Text

from strapdown.checks import InputError
from strapdown.cli.progress import PlainConsole, progress_bar
from strapdown.files import json_text, usable_folder, writable, write_json

if TYPE_CHECKING:
    from strapdown.recordings import Recording
    from strapdown.results import Table
    from strapdown.scenarios import Scenario

LARGEST_NUMBER = 1e30
"""Maximum of a number in a scenario, in any unit; squares and products of larger ones overflow."""
MAX_MEASUREMENTS = 1e8
"""Maximum number of measurements of one sensor in a scenario; more do not fit into memory."""

app = typer.Typer(
    help="Strapdown gyro attitude estimation: simulate, estimate, judge.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
# Without markup, so that brackets in file names are printed; a statement is one line, which the terminal wraps.
console = PlainConsole(markup=False, highlight=False, soft_wrap=True)


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Register a command; a parameter whose type is a dataclass becomes one option per field, under one heading of --help."""
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
    """Return the fields of a group as parameters; the first line of its docstring is the heading in --help."""
    hints = get_type_hints(group)
    found = []
    for field in dataclasses.fields(group):
        option: Any = copy.copy(field.default)
        option.rich_help_panel = group.__doc__.partition("\n")[0].rstrip(".")
        kind = inspect.Parameter.KEYWORD_ONLY
        found.append(inspect.Parameter(field.name, kind, default=option, annotation=hints[field.name]))
    return found


def options_given(group: Any) -> list[str]:
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
"""Option of all commands that draw figures."""
TABLES: Any = typer.Option(
    None, "--tables", help="Folder to which the tables are also written, as CSV with all digits and as LaTeX."
)
"""Option of all commands that print the tables of a study."""


def say(*sentences: str) -> None:
    """Print sentences, each on its line; empty ones are omitted."""
    for sentence in filter(None, sentences):
        console.print(sentence)


def counted(number: int, what: str) -> str:
    """Return a number with a noun, in the plural unless it is one."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def show(table: Table, title: str | None = None, *, notes: bool = True) -> None:
    """Print a table, optionally under another title; on a narrow terminal its lines wrap and are not cut off."""
    console.print(title or table.title, style="bold")
    rows = rich.table.Table(box=box.SIMPLE_HEAD, header_style="", pad_edge=False, padding=(0, 1, 0, 0))
    for k, column in enumerate(table.head):
        rows.add_column(column, justify="left" if k < table.left else "right", no_wrap=k > 0 or table.left == 1)
    styles = {"pass": "green", "FAIL": "red", "likely": "red"}
    for row in table.cells:
        # Only plain strings are cleared of control characters.
        rows.add_row(*(Text(cell, style=styles[cell]) if cell in styles else cell for cell in row))
    width, console.width = console.width, 1000
    try:
        console.print(rows, crop=False)
    finally:
        console.width = width
    say(*(table.notes if notes else ()))


def tables_written(folder: Path | None, *tables: Table) -> list[Path]:
    """Write tables to the folder of ``--tables``, if one is given, and return the files."""
    if folder is None:
        return []
    from strapdown.report.tables import write

    return write(tables, folder)


def tables_folder(folder: Path | None) -> None:
    """Raise an error if the folder of ``--tables`` cannot be written to, before anything is computed."""
    if folder is not None:
        usable_folder("--tables", folder)


def scenario_named(name: str) -> Scenario:
    """Return the scenario of a name or a TOML file, after checking that its numbers are within the range of computation."""
    from strapdown.scenarios import load_scenario, scenario_to_table

    chosen = load_scenario(name)
    for key, number in _numbers("", scenario_to_table(chosen)):
        if LARGEST_NUMBER < abs(number) < float("inf"):  # infinity is valid, as for a time that never comes
            raise InputError(f"{name}: {key} is {number:g}, which is impossible; check it and its unit")
    if chosen.duration * chosen.rate < 1.0:
        raise InputError(
            f"{name}: {chosen.duration:g} s at {chosen.rate:g} Hz are less than one gyro sample; increase the duration or the rate"
        )
    for sensor in chosen.sensors:
        measurements = chosen.duration * getattr(sensor, "rate", 0.0)
        if measurements > MAX_MEASUREMENTS:
            raise InputError(
                f"{name}: {sensor.name} would measure {measurements:.3g} times, more than {MAX_MEASUREMENTS:.0e}; lower its rate or "
                "the duration"
            )
    return chosen


def _numbers(place: str, content: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers in a TOML table with their places."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _numbers(f"{place}.{key}" if place else key, value)
    elif isinstance(content, list):
        for k, value in enumerate(content):
            yield from _numbers(f"{place}[{k}]", value)
    elif isinstance(content, (int, float)) and not isinstance(content, bool):
        yield place, float(content)


def need_own(target: Path, command: str, own: Callable[[Path], bool]) -> None:
    """Raise an error if the command would replace a file that it did not write, of which there may be no other copy."""
    try:
        replaceable = not target.exists() or own(target)
    except InputError:
        replaceable = False
    if not replaceable:
        raise InputError(
            f"{target} exists and was not written by `strapdown {command}`; move it, or choose another --out"
        )


def warn_about_conventions(source: Recording, path: Path) -> None:
    """Warn if axes, signs or units of a recording seem wrong."""
    from strapdown.ahrs import check_conventions

    with progress_bar("testing conventions"):
        found = check_conventions.examine(source)
    say(
        *(
            f"warning: {words}. See `strapdown doctor {path}`, with the same options of the file."
            for words in found.warnings
        )
    )


STANDARD_OUTPUT = Path("-")


def json_target(json: Path | None, *sources: Path | None) -> None:
    """Raise an error if a JSON file cannot be written; "-" is standard output, and all other output then goes to standard error."""
    if json == STANDARD_OUTPUT:
        console.stderr = True
    elif json is not None:
        writable("json", json, suffixes=(".json",), sources=sources)


def put_json(json: Path | None, content: Any) -> None:
    """Write JSON to the target, if one is given."""
    if json == STANDARD_OUTPUT:
        sys.stdout.write(json_text(content))
    elif json is not None:
        write_json(json, content)
        written(json)


def written(*paths: Any) -> None:
    """Print which files were written."""
    console.print("Written: " + ", ".join(str(path) for path in paths))
