"""The consoles, and progress of long computations on standard error: a bar on a terminal, otherwise a line every ten seconds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

import rich.progress as bars
from rich.console import Console
from rich.text import Text

from strapdown.checks import Hint

_CONTROL = dict.fromkeys((*range(9), *range(11, 32), *range(127, 160)), "�")
"""Control characters except tab and newline."""
_OPTIONS = {
    "initial": "--attitude or --from-truth",
    "noise": "--gyro",
    "priors": "--prior",
    "estimator": "--filter",
    "setup": "--filter",
}
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
    return f"{flag} {','.join(f'{name}={value}' for name, value in parts) or hint.value}"


class PlainConsole(Console):
    """A console that names options in hints, and shows no control characters: names of files may hold sequences that change a terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text with options in its hints and a mark in place of each control character."""
        return super().render_str(Hint.replaced(text, option).translate(_CONTROL), **options)


errors = PlainConsole(stderr=True, markup=False, highlight=False)

LINE_INTERVAL = 10.0
"""Time between two lines if the output is no terminal, s."""

_quiet = False


def be_quiet() -> None:
    """Show no progress from now on."""
    global _quiet  # noqa: PLW0603 (one process runs one command)
    _quiet = True


def rate_text(speed: float) -> str:
    """Return a rate with three digits, or as an integer if it has more."""
    return f"{speed:.0f}" if speed >= 100.0 else f"{speed:.3g}"


class _Rate(bars.ProgressColumn):
    """Runs per second, recent or, of a finished task, on average."""

    def render(self, task: bars.Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{rate_text(speed)} runs/s")


Advance = Callable[[int | str], None]
"""Advances the progress by a number of units, or sets the description of the current task."""


@contextmanager
def progress_bar(what: str, total: int | None = None) -> Iterator[Advance]:
    """Yield a function that advances the progress; without ``total`` only the time is shown."""
    if _quiet:
        yield lambda step: None
    elif errors.is_terminal:
        known = (
            (bars.MofNCompleteColumn(), *([_Rate()] if what == "runs" else []), bars.TimeRemainingColumn())
            if total
            else ()
        )
        columns = (bars.TextColumn("{task.description}"), bars.BarColumn(), *known, bars.TimeElapsedColumn())
        with bars.Progress(*columns, console=errors, transient=True) as progress:
            task = progress.add_task(what, total=total)
            yield lambda step: progress.update(
                task, **({"description": step} if isinstance(step, str) else {"advance": step})
            )
    else:
        with _lines(what, total) as advance:
            yield advance


@contextmanager
def _lines(what: str, total: int | None) -> Iterator[Advance]:
    done, begin, ended = 0, time.monotonic(), Event()

    def advance(step: int | str) -> None:
        nonlocal done, what
        if isinstance(step, str):
            what = step
        else:
            done += step

    def watch() -> None:
        while not ended.wait(LINE_INTERVAL):
            share = "" if total is None else f" {done} of {total},"
            errors.print(f"{what}:{share} {time.monotonic() - begin:.0f} s", soft_wrap=True)

    watcher = Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield advance
    finally:
        ended.set()
        watcher.join()
