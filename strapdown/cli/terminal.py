"""Functions shared by all commands: the application, the two consoles, tables, shared options, checks of files."""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_type_hints

import rich.table
import typer
from rich import box
from rich.text import Text
from typer import Option

from strapdown.checks import InputError
from strapdown.cli.progress import PlainConsole, progress_bar
from strapdown.files import json_text, usable_folder, writable, write_json

if TYPE_CHECKING:
    from strapdown.recordings import Recording
    from strapdown.results import Table

app = typer.Typer(
    help="Strapdown gyro attitude estimation: simulate, estimate, judge.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
# Without markup, so that brackets in file names are printed; a statement is one line, which the terminal wraps.
console = PlainConsole(markup=False, highlight=False, soft_wrap=True)

Format = Literal["png", "pdf", "svg"]
"""Formats of figures."""
FORMAT: Any = Option("png", "--format", help="Format of the figures.")
TABLES: Any = Option(None, help="Folder to which the tables are also written, as CSV with all digits and as LaTeX.")
FILTER: Any = Option(None, "--filter", help="TOML with a table named filter. Default: a matched one.")
STATES: Any = Option(
    None,
    "--states/--no-states",
    help="A state for each specified error, or none. Default: if the matched filter needs them.",
)
GYRO: Any = Option(None, help="TOML with a table named gyro, as of `strapdown allan`: the gyro noise of the filter.")
CANNOT_TELL = 3
STATUS = {"consistent": 0, "as declared": 0, "not consistent": 1, "wrong convention": 1}
"""Exit status of a verdict, otherwise :data:`CANNOT_TELL`; 2 is that of bad usage or input."""
SCENARIO = "Name of a built-in scenario, or a TOML file."


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Register a command; a parameter whose type is a dataclass becomes one option per field, under one heading of --help."""
    hints = get_type_hints(function)
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
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return app.command()(run)


def _options(group: Any) -> list[inspect.Parameter]:
    """Return the fields of a group as parameters; the first line of its docstring is the heading in --help."""
    hints = get_type_hints(group)
    parameters = []
    for field in dataclasses.fields(group):
        option: Any = copy.copy(field.default)
        option.rich_help_panel = group.__doc__.partition("\n")[0].rstrip(".")
        kind = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(field.name, kind, default=option, annotation=hints[field.name]))
    return parameters


def options_given(group: Any) -> list[str]:
    """Return the options of a group that were given, as on the command line."""
    flags = []
    for field in dataclasses.fields(group):
        option: Any = field.default
        if getattr(group, field.name) not in (option.default, []):
            flag = option.param_decls[0] if option.param_decls else "--" + field.name.replace("_", "-")
            flags.append(flag.partition("/")[0])
    return flags


def say(*sentences: str) -> None:
    """Print sentences, each on its line; empty ones are omitted."""
    for sentence in filter(None, sentences):
        console.print(sentence)


def counted(number: int, what: str) -> str:
    """Return a number with a noun, in the plural unless it is one."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def show(*tables: Table, title: str | None = None, notes: bool = True) -> None:
    """Print tables, optionally under another title; on a narrow terminal their lines wrap and are not cut off."""
    styles = {"pass": "green", "FAIL": "red", "likely": "red"}
    for table in tables:
        console.print(title or table.title, style="bold")
        rows = rich.table.Table(box=box.SIMPLE_HEAD, header_style="", pad_edge=False, padding=(0, 1, 0, 0))
        for k, column in enumerate(table.head):
            rows.add_column(column, justify="left" if k < table.left else "right", no_wrap=k > 0 or table.left == 1)
        for row in table.cells:
            # Only plain strings are cleared of control characters.
            rows.add_row(*(Text(cell, style=styles[cell]) if cell in styles else cell for cell in row))
        width, console.width = console.width, 1000
        try:
            console.print(rows, crop=False)
        finally:
            console.width = width
        say(*(table.notes if notes else ()))


def check_files(
    *paths: Path,
    tables: Path | None = None,
    sources: Any = (),
    suffixes: tuple[str, ...] = (),
    own: Callable[[Path], bool] | None = None,
    command: str = "",
) -> None:
    """Raise an error, before anything is computed, for output files that cannot be written; ``tables``: folder of ``--tables``.

    ``own``: whether the first file was written by ``command``, which replaces no other, of which there may be no copy.
    """
    writable("out", *paths, suffixes=suffixes, sources=sources)
    if tables is not None:
        usable_folder("--tables", tables)
    if own is None:
        return
    try:
        replaceable = not paths[0].exists() or own(paths[0])
    except InputError:
        replaceable = False
    if not replaceable:
        raise InputError(
            f"{paths[0]} exists and was not written by `strapdown {command}`; move it, or choose another --out"
        )


def written(*paths: Any, tables: tuple[Path | None, Any] = (None, ())) -> None:
    """Print which files were written; ``tables``: folder of ``--tables``, if one is given, and the tables to write to it."""
    folder, listed = tables
    if folder is not None:
        from strapdown.report.tables import write

        paths = (*paths, *write(listed, folder))
    if paths:
        console.print("Written: " + ", ".join(map(str, paths)))


def warn_about_conventions(source: Recording, path: Path) -> None:
    """Warn if axes, signs or units of a recording seem wrong."""
    from strapdown.ahrs import check_conventions

    with progress_bar("testing conventions"):
        doubts = check_conventions.examine(source).warnings
    say(*(f"warning: {words}. See `strapdown doctor {path}`, with the same options of the file." for words in doubts))


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
