"""Progress of long computations on standard error: a bar on a terminal, otherwise a line every ten seconds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

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
    flag = _OPTIONS.get(hint.argument, "--" + hint.argument.replace("_", "-"))
    if hint.value is None or hint.value is True:
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
_POLL = 0.2

_quiet = False


def be_quiet() -> None:
    """Show no progress from now on."""
    global _quiet  # noqa: PLW0603 (one process runs one command)
    _quiet = True


def rate_text(speed: float) -> str:
    """Return a rate with three digits, or as an integer if it has more."""
    return f"{speed:.0f}" if speed >= 100.0 else f"{speed:.3g}"


class _Rate(ProgressColumn):
    """Units per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Return the recent rate, or the mean rate of a finished task."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{rate_text(speed)} {self._unit}")


Advance = Callable[[int | str], None]
"""Advances the progress by a number of units, or sets the description of the current task."""


@contextmanager
def progress_bar(what: str, total: int | None = None, *, rate: str = "") -> Iterator[Advance]:
    """Yield a function that advances the progress; without ``total`` only the time is shown."""
    if _quiet:
        yield lambda step: None
        return
    done, ended = 0, Event()

    def advance(step: int | str) -> None:
        nonlocal done, what
        if isinstance(step, str):
            what = step
        else:
            done += step

    def watch(say: Say) -> None:
        begin = time.monotonic()
        while not ended.wait(_POLL):
            say(what, done, time.monotonic() - begin)

    with _terminal(what, total, rate) if errors.is_terminal else _lines(total) as say:
        watcher = Thread(target=watch, args=(say,), daemon=True)
        watcher.start()
        try:
            yield advance
        finally:
            ended.set()
            watcher.join()


Say = Callable[[str, int, float], None]
"""Shows the task, the number of completed units, and the elapsed time, s."""


@contextmanager
def _terminal(what: str, total: int | None, rate: str) -> Iterator[Say]:
    known = (MofNCompleteColumn(), *([_Rate(rate)] if rate else []))
    columns = (TextColumn("{task.description}"), BarColumn(), *(known if total is not None else ()))
    left = (TextColumn("left"), TimeRemainingColumn()) if total is not None else ()
    with Progress(*columns, TimeElapsedColumn(), *left, console=errors, transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda now, done, _: progress.update(task, description=now, completed=done)


@contextmanager
def _lines(total: int | None) -> Iterator[Say]:
    next_line = LINE_INTERVAL

    def say(now: str, done: int, seconds: float) -> None:
        nonlocal next_line
        if seconds >= next_line:
            next_line += LINE_INTERVAL
            share = "" if total is None else f" {done} of {total},"
            errors.print(f"{now}:{share} {seconds:.0f} s", soft_wrap=True)

    yield say
