"""Optional libraries, with an error that names a missing one."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from strapdown.checks import InputError


def library(name: str, what: str, extra: str = "formats") -> Any:
    """Return an optional module; if it is not installed, raise an InputError with its purpose and how to install it."""
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0].replace("_", "-")
        raise InputError(f"{what} needs {package} ({error}); pip install 'strapdown[{extra}]'") from None


def with_ending(path: Path, ending: str, folder: Path) -> Path:
    """Return a path to the file with that extension, which some libraries require: if necessary, a link in ``folder``."""
    if path.suffix.lower() == ending:
        return path
    link = folder / f"{path.stem}{ending}"
    link.symlink_to(path.absolute())
    return link
