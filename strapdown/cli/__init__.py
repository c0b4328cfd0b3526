"""The command line. Only this package prints; units are degrees, hours and arcseconds here and radians and seconds below.

A result replaces all of an earlier result of the same name. ``estimate``, ``simulate``, ``integrate`` and ``tune`` refuse to replace a file
that they did not write; ``montecarlo``, whose result may have taken hours, needs ``--resume`` or ``--overwrite``.

- ``terminal``: What every command shares.
- ``progress``: Progress of what takes long.
- ``layout``: Groups, order, modules and examples of the commands.
- ``studies``: ``coning``
- ``integration``: ``algorithms``, ``integrate``, ``coning-budget``
- ``estimation``: ``estimate``
- ``reading``: Options of every command that reads a recording.
- ``conversion``: ``convert``
- ``campaigns``: ``montecarlo``
- ``judgement``: ``check``, ``doctor``
- ``planning``: ``covariance``
- ``reporting``: ``report``
- ``sensors``: ``simulate``, ``scenarios``, ``allan``
- ``tuning``: ``tune``
- ``installation``: ``info``
"""

from __future__ import annotations

import functools
import io
import sys
import traceback
import warnings
from collections.abc import Callable
from typing import Any

import typer

from strapdown.checks import OF_YOUR_OWN, InputError
from strapdown.cli.layout import register as register
from strapdown.cli.progress import be_quiet
from strapdown.cli.terminal import app, console, errors
from strapdown.files.reading import NoDigestWarning


@app.callback(invoke_without_command=True)
def _about(
    version: bool = typer.Option(False, "--version", help="Print the version and stop.", is_eager=True),
    quiet: bool = typer.Option(
        False, "--quiet", help="Show no progress on standard error; may stand after the command too."
    ),
) -> None:
    if quiet:
        be_quiet()
    if version:
        import strapdown

        console.print(f"strapdown {strapdown.__version__}")
        raise typer.Exit


def _say(usual: Callable[..., None], message: Warning | str, category: type[Warning], *place: Any) -> None:
    """Say a warning about a file in one line, without where in the code it came up."""
    if issubclass(category, NoDigestWarning):
        errors.print(f"warning: {message}", soft_wrap=True)
    else:
        usual(message, category, *place)


FAULT = 70
"""Exit status of a fault of the program itself (EX_SOFTWARE of BSD): no verdict, and not bad input."""


def main() -> None:
    """Run the command line; bad input ends with one clear line and status 2, Ctrl-C with 130, a fault of the program with 70."""
    warnings.showwarning = functools.partial(_say, warnings.showwarning)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what ASCII or cp1252 has no sign for is a question mark, not the end
            stream.reconfigure(errors="replace")
    console.stderr = False  # --json - of an earlier command in this process
    if "--quiet" in sys.argv[1:]:
        sys.argv = [sys.argv[0], "--quiet", *(argument for argument in sys.argv[1:] if argument != "--quiet")]
    try:
        register(next((one for one in sys.argv[1:] if not one.startswith("-")), None))
        app(standalone_mode=True)
    except InputError as error:
        errors.print(f"error: {error}", soft_wrap=True)
        sys.exit(2)
    except OSError as error:
        errors.print(f"error: {error}; check the path and the space left", soft_wrap=True)
        sys.exit(2)
    except MemoryError as error:
        errors.print(f"error: not enough memory ({error}); shorten the record, or lower the rates", soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        errors.print("interrupted")
        sys.exit(130)
    except Exception as error:
        import strapdown

        traceback.print_exc()
        for note in getattr(error, "__notes__", ()):
            if OF_YOUR_OWN in note:
                errors.print(
                    f"error: {note} ({type(error).__name__}); its lines end the traceback above", soft_wrap=True
                )
                sys.exit(2)
        errors.print(
            f"error: a fault of strapdown {strapdown.__version__} itself ({type(error).__name__}), not a verdict and not your input; "
            "please report the traceback above with the command",
            soft_wrap=True,
        )
        sys.exit(FAULT)
