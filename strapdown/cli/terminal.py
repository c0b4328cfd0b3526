"""Functions shared by all commands: the application and its console, declaration of a command, shared options, tables, checks of files."""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_type_hints

import rich.table
import typer
from rich import box
from rich.text import Text
from typer import Option

from strapdown.checks import InputError
from strapdown.cli.progress import PlainConsole, progress_bar  # noqa: F401 (for the commands)
from strapdown.files import json_text, reading, usable_folder, writable, write_json

if TYPE_CHECKING:
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
FILTER: Any = Option(None, "--filter", help="TOML with a table named filter. Default: a matched one.")
STATES: Any = Option(
    None,
    "--states/--no-states",
    help="A state for each specified error, or none. Default: if the matched filter needs them.",
)
GYRO: Any = Option(None, help="TOML with a table named gyro, as of `strapdown allan`: the gyro noise of the filter.")
SCENARIO = "Name of a built-in scenario, or a TOML file."
_EXTRA: dict[str, Any] = {
    "tables": Option(None, help="Folder to which the tables are also written, as CSV with all digits and as LaTeX."),
    "json": Option(None, "--json", help="File for all numbers; - for standard output."),
}
"""Options that :func:`command` adds and serves."""
STANDARD_OUTPUT = Path("-")
OUTPUTS = ("out", "to", "target", "aligned", "json", "tables")
"""Parameters of commands that name files to write; paths in all others are read."""
CANNOT_TELL = 3
STATUS = {"consistent": 0, "as declared": 0, "not consistent": 1, "wrong convention": 1}
"""Exit status of a verdict, otherwise :data:`CANNOT_TELL`; 2 is that of bad usage or input."""


_running: dict[str, Any] = {"name": "", "paths": [], "tables": []}
"""Of the command that runs: its name, the paths that it reads, and the tables that it has shown."""


def command(*extra: str) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Register a command; a parameter whose type is a dataclass becomes one option per field, under one heading of --help.

    A command returns its numbers, if it has any; a verdict among them becomes the exit status. ``extra``: ``"tables"`` adds the option that
    writes the tables that were shown, ``"json"`` the one that writes these numbers.
    """

    def registered(function: Callable[..., Any]) -> Callable[..., None]:
        hints: dict[str, Any] = get_type_hints(function)
        groups: dict[str, Any] = {name: hint for name, hint in hints.items() if dataclasses.is_dataclass(hint)}

        @functools.wraps(function)
        def run(**values: Any) -> None:
            paths = [value for name, value in values.items() if name not in OUTPUTS]
            paths = [path for value in paths for path in (value if isinstance(value, list) else [value])]
            paths = [path for path in paths if isinstance(path, (str, Path))]
            _running.update(name=function.__name__, paths=paths, tables=[])
            folder, target = (values.pop(name, None) for name in ("tables", "json"))
            if target == STANDARD_OUTPUT:  # all other output then goes to standard error
                console.stderr = True
            elif target is not None:
                check_files(target, suffixes=(".json",), name="json")
            if folder is not None:
                usable_folder("--tables", folder)
            for name, group in groups.items():
                values[name] = group(**{field.name: values.pop(field.name) for field in dataclasses.fields(group)})
            _end(function(**values) or {}, target, folder)

        parameters = [*_parameters(function), *(_parameter(name, _EXTRA[name], Path | None) for name in extra)]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return app.command()(run)

    return registered


def _parameter(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _parameters(function: Callable[..., Any]) -> Iterator[inspect.Parameter]:
    """Yield the parameters of a command, for a group its fields; the first line of its docstring is their heading in --help."""
    hints = get_type_hints(function)
    for name, parameter in inspect.signature(function).parameters.items():
        if not dataclasses.is_dataclass(hints[name]):
            yield _parameter(name, parameter.default, hints[name])
            continue
        types = get_type_hints(hints[name])
        for field in dataclasses.fields(hints[name]):
            option: Any = copy.copy(field.default)
            option.rich_help_panel = str(hints[name].__doc__).partition("\n")[0].rstrip(".")
            yield _parameter(field.name, option, types[field.name])


def _end(numbers: dict[str, Any], target: Path | None, folder: Path | None) -> None:
    """Write numbers and tables where they are wanted, and end with the status of a verdict."""
    if target == STANDARD_OUTPUT:
        sys.stdout.write(json_text(numbers))
    elif target is not None:
        write_json(target, numbers)
        written(target)
    if folder is not None:
        from strapdown.report.tables import write

        written(*write([table for table in _running["tables"] if table.name], folder))
    if "verdict" in numbers:
        raise typer.Exit(STATUS.get(numbers["verdict"], CANNOT_TELL))


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
    _running["tables"].extend(tables)


def check_files(
    *paths: Path,
    name: str = "out",
    suffixes: tuple[str, ...] = (),
    own: str | Callable[[Path], Any] = "",
    reads: bool = True,
) -> None:
    """Raise an error, before anything is computed, for output files that cannot be written, or are among the files read.

    ``own``: kind of the first file, or its reader: a file that this command did not write is not replaced. ``reads``: False for a file that
    the command may read and continue.
    """
    writable(name, *paths, suffixes=suffixes, sources=_running["paths"] if reads else ())
    if not own or not paths[0].exists():
        return
    try:
        replaceable = reading.kind(paths[0]) == own if isinstance(own, str) else own(paths[0])
    except InputError:
        replaceable = False
    if not replaceable:
        raise InputError(
            f"{paths[0]} exists and was not written by `strapdown {_running['name']}`; move it, or choose another --out"
        )


def written(*paths: Any) -> None:
    """Print which files were written."""
    if paths:
        console.print("Written: " + ", ".join(map(str, paths)))


def by_name(option: str, texts: Iterable[str], form: str) -> dict[str, str]:
    """Return the values of an option by name, given as texts NAME=VALUE; ``form`` is the one to give."""
    values: dict[str, str] = {}
    for text in filter(None, texts):
        name, _, value = (part.strip() for part in text.partition("="))
        if not name or not value:
            raise InputError(f"{option} is {text.strip()!r}; give {form}")
        if name in values:
            raise InputError(f"{option}: {name} is given twice; give it once")
        values[name] = value
    return values


def numbers(option: str, text: str, form: str, *lengths: int) -> list[float]:
    """Return the numbers of an option, separated by commas; ``form`` says which to give, ``lengths`` how many there may be."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in lengths:
        raise InputError(f"{option} is {text!r}; give {form}")
    return values
