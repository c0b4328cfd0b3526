"""Functions shared by all commands: the consoles, declaration of a command, tables, checks of files, and progress of long computations.

Progress is on standard error: a bar on a terminal, otherwise a line every ten seconds.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import inspect
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, get_type_hints

import rich.progress as bars
import typer
from rich.console import Console
from rich.text import Text
from typer import Option
from typer.models import OptionInfo

from strapdown.checks import Hint, InputError
from strapdown.files import json_text, reading, usable_folder, writable, write_json

if TYPE_CHECKING:
    from strapdown.results import Table

_CONTROL = dict.fromkeys((*range(9), *range(11, 32), *range(127, 160)), "�")
"""Control characters except tab and newline."""
_OPTIONS = {"initial": "--attitude or --from-truth", "noise": "--gyro", "priors": "--prior"}
_OPTIONS |= {"estimator": "--filter", "setup": "--filter", "sequence": "--euler"}
"""Options whose names differ from those of the argument in Python."""


def option(hint: Hint) -> str:
    """Return the option for an argument of Python, with its value."""
    name = hint.argument.replace("_", "-")
    flag = _OPTIONS.get(hint.argument, f"--no-{name}" if hint.value is False else f"--{name}")
    if hint.value is None or isinstance(hint.value, bool):
        return flag
    if hint.argument == "units":
        return " ".join(f"--{name}-unit {unit}" for name, unit in hint.value.items())
    parts = hint.value.items() if isinstance(hint.value, dict) else ()
    return f"{flag} {shlex.quote(','.join(f'{name}={value}' for name, value in parts) or str(hint.value))}"


class PlainConsole(Console):
    """A console that names options in hints, and shows no control characters: names of files may hold sequences that change a terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text with options in its hints and a mark in place of each control character."""
        return super().render_str(Hint.replaced(text, option).translate(_CONTROL), **options)

    def on_broken_pipe(self) -> None:
        """Print nothing more and go on, so that a command whose output goes to ``head`` still writes its files."""
        self.quiet = True
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), self.file.fileno())  # for what Python flushes at the end


app = typer.Typer(
    help="Strapdown gyro attitude estimation: simulate, estimate, judge.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
# Without markup, so that brackets in file names are printed; a statement is one line, which the terminal wraps.
console = PlainConsole(markup=False, highlight=False, soft_wrap=True)
errors = PlainConsole(stderr=True, markup=False, highlight=False)

_EXTRA: dict[str, Any] = {
    "tables": Option(None, help="Folder to which the tables are also written, as CSV with all digits and as LaTeX."),
    "json": Option(None, "--json", help="File for all numbers; - for standard output."),
}
"""Options that :func:`command` adds and serves."""
KEYWORD = inspect.Parameter.KEYWORD_ONLY
EVIDENCE = "Statistics of the filter and their bounds for a consistent filter"
"""Title of the findings of a judgement, whose own title, the verdict, stands below them."""

OUTPUTS = ("out", "to", "target", "aligned", "json", "tables")
"""Parameters of commands that name files to write; paths in all others are read."""
STATUS = {"consistent": 0, "as declared": 0, "not consistent": 1, "wrong convention": 1, "cannot tell": 3}
"""Exit status of a verdict; 2 is that of bad usage or input."""

_running: dict[str, Any] = {"name": "", "paths": [], "tables": []}
"""Of the command that runs: its name, the paths that it reads, and the tables that it has shown."""


def command(*extra: str) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Register a command; a parameter whose type is a dataclass becomes one option per field, under one heading of --help.

    A command returns its numbers, if it has any; a verdict among them becomes the exit status. ``extra``: ``"tables"`` adds the option that
    writes the tables that were shown, ``"json"`` the one that writes these numbers.
    """

    def registered(function: Callable[..., Any]) -> Callable[..., None]:
        hints: dict[str, Any] = get_type_hints(function)
        groups = [name for name, hint in hints.items() if dataclasses.is_dataclass(hint)]

        @functools.wraps(function)
        def run(**values: Any) -> None:
            inputs = (value for name, value in values.items() if name not in OUTPUTS)
            paths = [path for value in inputs for path in (value if isinstance(value, list) else [value])]
            paths = [path for path in paths if isinstance(path, (str, Path))]
            _running.update(name=function.__name__, paths=paths, tables=[])
            folder, target = (values.pop(name, None) for name in ("tables", "json"))
            printed = target == Path("-")
            if printed:  # all other output then goes to standard error
                console.stderr = True
            elif target is not None:
                check_files(target, suffixes=(".json",), name="--json")
            if folder is not None:
                usable_folder("--tables", folder)
            for name in groups:
                fields = [field.name for field in dataclasses.fields(hints[name])]
                values[name] = hints[name](**{field: values.pop(field) for field in fields})
            try:
                numbers = function(**values) or {}
            except InputError as error:  # of an argument of Python: named as the option
                argument, blank, words = str(error).partition(" ")
                if argument in options:
                    error.args = (f"{option(Hint(argument))}{blank}{words}",)
                raise
            if printed:
                sys.stdout.write(json_text(numbers))
            elif target is not None:
                write_json(target, numbers)
                written(target)
            if folder is not None:
                from strapdown.report.tables import write

                written(*write([table for table in _running["tables"] if table.name], folder))
            if "verdict" in numbers:
                raise typer.Exit(STATUS[numbers["verdict"]])

        parameters = list(_parameters(function, hints))
        options = {parameter.name for parameter in parameters if isinstance(parameter.default, OptionInfo)}
        parameters += [inspect.Parameter(name, KEYWORD, default=_EXTRA[name], annotation=Path | None) for name in extra]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return app.command()(run)

    return registered


def _parameters(function: Callable[..., Any], hints: dict[str, Any]) -> Iterator[inspect.Parameter]:
    """Yield the parameters of a command or of a group; those of a group have the first line of its docstring as heading in --help."""
    for name, parameter in inspect.signature(function).parameters.items():
        if dataclasses.is_dataclass(hints[name]):
            for field in _parameters(hints[name], get_type_hints(hints[name])):
                option = copy.copy(field.default)
                option.rich_help_panel = str(hints[name].__doc__).partition("\n")[0].rstrip(".")
                yield field.replace(default=option)
        else:
            yield parameter.replace(kind=KEYWORD, annotation=hints[name])


def say(*sentences: str) -> None:
    """Print sentences, each on its line; empty ones are omitted."""
    for sentence in filter(None, sentences):
        console.print(sentence)


def show(*tables: Table, title: str | None = None, notes: bool = True) -> None:
    """Print tables, optionally under another title; on a narrow terminal their lines wrap and are not cut off."""
    for table in tables:
        console.print(title or table.title, style="bold")
        for line in table.lines:
            row = console.render_str(line)
            row.highlight_regex(r"(?<!\S)pass$", "green")
            row.highlight_regex(r"(?<!\S)(FAIL|likely)$", "red")
            console.print(row)
        console.print()
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
    replaceable = False
    with contextlib.suppress(InputError):
        replaceable = reading.kind(paths[0]) == own if isinstance(own, str) else own(paths[0])
    if not replaceable:
        raise InputError(
            f"{paths[0]} exists and was not written by `strapdown {_running['name']}`; move it, or choose another --out"
        )


def written(*paths: Path) -> None:
    """Print which files were written."""
    say(f"Written: {', '.join(map(str, paths))}" if paths else "")


LINE_INTERVAL = 10.0
"""Time between two lines if the output is no terminal, s."""

_quiet = False


def be_quiet() -> None:
    """Show no progress from now on."""
    global _quiet  # noqa: PLW0603 (one process runs one command)
    _quiet = True


@contextlib.contextmanager
def progress_bar(what: str, total: int | None = None) -> Iterator[Callable[[int | str], None]]:
    """Yield a function that advances the progress by a number of units, or describes it; without ``total`` only the time is shown."""
    done, begin, ended = 0, time.monotonic(), Event()

    def advance(step: int | str) -> None:
        nonlocal done, what
        what, done = (step, done) if isinstance(step, str) else (what, done + step)
        if bar is not None:
            bar.update(task, description=what, completed=done)

    def watch() -> None:
        while not ended.wait(LINE_INTERVAL):
            share = "" if total is None else f" {done} of {total},"
            errors.print(f"{what}:{share} {time.monotonic() - begin:.0f} s", soft_wrap=True)

    bar = None
    if errors.is_terminal and not _quiet:
        columns = (*bars.Progress.get_default_columns(), bars.TimeElapsedColumn())
        bar = bars.Progress(*columns, console=errors, transient=True)
        task = bar.add_task(what, total=total)
    watcher = Thread(target=watch, daemon=True)
    with bar or contextlib.nullcontext():
        if bar is None and not _quiet:
            watcher.start()
        try:
            yield advance
        finally:
            ended.set()
            if watcher.ident is not None:
                watcher.join()
