"""Progress of long computations and of compilation on standard error: a bar on a terminal, otherwise a line every ten seconds."""

from __future__ import annotations

import sys
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
            _compiling.listen()
            say(_compiling.current, what, done, time.monotonic() - begin)

    with _terminal(what, total, rate) if errors.is_terminal else _lines(total) as say:
        watcher = Thread(target=watch, args=(say,), daemon=True)
        watcher.start()
        try:
            yield advance
        finally:
            ended.set()
            watcher.join()
            _compiling.current = ""


Say = Callable[[str, str, int, float], None]
"""Shows the state of the compilation, if any, the task, the number of completed units, and the elapsed time, s."""


@contextmanager
def _terminal(what: str, total: int | None, rate: str) -> Iterator[Say]:
    known = (MofNCompleteColumn(), *([_Rate(rate)] if rate else []))
    columns = (TextColumn("{task.description}"), BarColumn(), *(known if total is not None else ()))
    left = (TextColumn("left"), TimeRemainingColumn()) if total is not None else ()
    with Progress(*columns, TimeElapsedColumn(), *left, console=errors, transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda compiling, now, done, _: progress.update(task, description=compiling or now, completed=done)


@contextmanager
def _lines(total: int | None) -> Iterator[Say]:
    next_line, announced = LINE_INTERVAL, False

    def say(compiling: str, now: str, done: int, seconds: float) -> None:
        nonlocal next_line, announced
        if compiling and not announced:
            announced = True
            errors.print("compiling for this machine; the compiled code is cached for later runs", soft_wrap=True)
        if seconds >= next_line:
            next_line += LINE_INTERVAL
            share = "" if total is None else f" {done} of {total},"
            errors.print(f"{compiling or now}:{share} {seconds:.0f} s", soft_wrap=True)

    yield say


class _Compiling:
    """Functions that numba is compiling, from numba's events; numba is not imported here."""

    def __init__(self) -> None:
        self.current = ""
        self._listening = False
        self._known: set[Any] = set()
        self._left: set[Any] = set()
        self._begun = 0
        """Number of compilations in progress; they are nested, since functions call each other."""

    def listen(self) -> None:
        """Register for the events once numba is imported."""
        numba = sys.modules.get("numba")
        if self._listening or numba is None or getattr(numba.__spec__, "_initializing", False):
            return
        event: Any = sys.modules["numba.core.event"]
        owner = self

        class Listener(event.Listener):  # type: ignore[misc]
            def on_start(self, happened: Any) -> None:
                owner.started(happened.data["dispatcher"])

            def on_end(self, happened: Any) -> None:
                owner.finished(happened.data["dispatcher"])

        event.register("numba:compile", Listener())
        self._listening = True

    def started(self, dispatcher: Any) -> None:
        """Count a function whose compilation starts, and all that it calls."""
        self._left |= _called(dispatcher) - self._known
        self._known |= self._left
        self._begun += 1
        self._say()

    def finished(self, dispatcher: Any) -> None:
        """Count a function as compiled."""
        self._left.discard(dispatcher)
        self._begun = max(self._begun - 1, 0)  # one that began before anyone listened was not counted
        if self._begun == 0:  # the remaining functions were not needed, or an error ended the compilation
            self._left.clear()
        self._say()

    def _say(self) -> None:
        number = len(self._known)
        done = number - len(self._left)
        self.current = f"compiling: {done} of {number} functions" if self._left else ""


def _called(dispatcher: Any) -> set[Any]:
    """Return a compiled function and those that it references, directly or indirectly."""
    found: set[Any] = set()
    open_ones = [dispatcher]
    while open_ones:
        one = open_ones.pop()
        if hasattr(one, "py_func") and one not in found:
            found.add(one)
            open_ones += one.py_func.__globals__.values() if _is_twin(one) else []
    return found


def _is_twin(dispatcher: Any) -> bool:
    """Return whether the globals of the function are only the names that it uses (:mod:`strapdown.kernels.machine`)."""
    return str(dispatcher.py_func.__module__).startswith("strapdown.kernels")


_compiling = _Compiling()
