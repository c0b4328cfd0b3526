"""The command line. Only this package prints. Units are degrees, hours and arcseconds here, radians and seconds in the other packages.

A result replaces an earlier result of the same name completely. ``estimate``, ``simulate``, ``integrate`` and ``tune`` never replace a file
that they did not write; ``montecarlo``, whose result may have taken hours, needs ``--resume`` or ``--overwrite``.

``terminal`` and ``options`` have what several commands share; the other modules define those that :data:`COMMANDS` assigns to them.
"""

from __future__ import annotations

import functools
import importlib
import io
import sys
import traceback
import warnings
from collections.abc import Callable
from typing import Any

import typer

from strapdown.checks import OF_YOUR_OWN, InputError
from strapdown.cli.terminal import app, be_quiet, console, errors

COMMANDS: dict[str, dict[str, tuple[str, ...]]] = {
    "Simulate, estimate, judge": {
        "scenarios": ("sensors",),
        "keys": ("sensors", "sensors", "coning"),
        "simulate": ("sensors", "two-stars", "satellite.toml --seed 2 --out flight.h5"),
        "estimate": ("estimation", "two-stars.h5", "walk.csv --gyro-unit deg/s --accelerometer-unit g --to angles.csv"),
        "check": ("judgement", "estimate-results/estimate.h5", "other.csv --truth flight.h5"),
        "report": ("judgement", "estimate-results/estimate.h5"),
        "montecarlo": ("campaigns", "satellite.toml --runs 400", "satellite.toml --filter mine.py:run"),
        "covariance": ("studies", "satellite.toml --consider scale_factor=300"),
    },
    "Noise and tuning": {
        "allan": ("allan", "rest.csv --gyro-unit deg/s"),
        "tune": ("tuning", "one.h5 two.h5 --filter guess.toml --holdout 0.4"),
    },
    "Recordings": {
        "doctor": ("recordings", "walk.csv --gyro-unit deg/s --accelerometer-unit g"),
        "calibrate": ("recordings", "slow.csv fast.csv --gyro-unit deg/s --accelerometer-unit g"),
        "convert": ("recordings", "walk.bag walk.csv"),
    },
    "Integration of the gyro": {
        "coning": ("studies", "", "--algorithm mine.toml --runs 20"),
        "integrate": ("studies", "flight.h5 --algorithm three-sample"),
        "algorithms": ("studies",),
        "coning-budget": ("studies", "--psd psd.csv --rate 200"),
    },
    "On a microcontroller": {"export": ("exporting", "filter.toml satellite.toml --precision single --out firmware")},
    "This installation": {"info": ("exporting",)},
}
"""Commands in groups, in the order of use, as in ``--help``: the module that registers each, and arguments of examples."""


def register(command: str | None = None) -> None:
    """Register one command and import only its module; register all if there is none of that name, for ``--help`` and errors."""
    places = {name: (title, *place) for title, group in COMMANDS.items() for name, place in group.items()}
    for module in dict.fromkeys(place[1] for name, place in places.items() if name == command or command not in places):
        importlib.import_module(f"strapdown.cli.{module}")
    name_of = lambda registered: registered.callback.__name__.replace("_", "-")  # noqa: E731
    app.registered_commands.sort(key=lambda registered: list(places).index(name_of(registered)))
    for registered in app.registered_commands:
        name = name_of(registered)
        registered.rich_help_panel, _, *examples = places[name]
        lines = (f"  strapdown {name} {arguments}".rstrip() for arguments in examples)
        registered.epilog = "\n\n".join(("Examples:", *lines)) if examples else None


@app.callback(invoke_without_command=True)
def _about(
    version: bool = typer.Option(False, "--version", help="Print the version and stop.", is_eager=True),
    quiet: bool = typer.Option(False, "--quiet", help="Show no progress; also allowed after the command."),
) -> None:
    if quiet:
        be_quiet()
    if version:
        import strapdown

        console.print(f"strapdown {strapdown.__version__}")
        raise typer.Exit


def _say(usual: Callable[..., None], message: Warning | str, category: type[Warning], *place: Any) -> None:
    """Print a warning of this package in one line, without its place in the code."""
    if not category.__module__.startswith("strapdown."):
        usual(message, category, *place)
    elif category.__name__ == "ConventionWarning":
        console.print(f"warning: {message}. See `strapdown doctor`, with the same file and its options.")
    else:
        errors.print(f"warning: {message}", soft_wrap=True)


def main() -> None:
    """Run the command line; bad input ends with one line and status 2, Ctrl-C with 130, an internal error with 70."""
    warnings.showwarning = functools.partial(_say, warnings.showwarning)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # characters missing in ASCII or cp1252 become question marks
            stream.reconfigure(errors="replace")
    console.stderr = False  # an earlier command in this process may have set it (--json -)
    if "--quiet" in sys.argv[1:]:
        sys.argv = [sys.argv[0], "--quiet", *(argument for argument in sys.argv[1:] if argument != "--quiet")]
    try:
        register(next((argument for argument in sys.argv[1:] if not argument.startswith("-")), None))
        app(standalone_mode=True)
        return
    except InputError as error:
        status, words = 2, f"{error}"
    except OSError as error:
        status, words = 2, f"{error}; check the path and the space left"
    except MemoryError as error:
        status, words = 2, f"not enough memory ({error}); shorten the record, or lower the rates"
    except KeyboardInterrupt:
        errors.print("interrupted")
        sys.exit(130)
    except Exception as error:
        import strapdown

        traceback.print_exc()
        status, words = (
            70,  # EX_SOFTWARE of BSD
            f"internal error of strapdown {strapdown.__version__} ({type(error).__name__}), not a verdict and not bad input; please report "
            "the traceback above with the command",
        )
        for note in getattr(error, "__notes__", ()):
            if OF_YOUR_OWN in note:
                status, words = 2, f"{note} ({type(error).__name__}); see the end of the traceback above"
    errors.print(f"error: {words}", soft_wrap=True)
    sys.exit(status)
