"""Optional libraries, with an error that names a missing one."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from strapdown.checks import InputError


def library(name: str, what: str, extra: str = "formats") -> Any:
    """Return an optional module; if it is not installed, raise an InputError with its purpose and how to install it."""
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0].replace("_", "-")
        raise InputError(f"{what} needs {package} ({error}); pip install 'strapdown[{extra}]'") from None
