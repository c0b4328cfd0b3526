"""Files: every file is read through ``reading`` and written through ``writing``.

- ``reading``: Limits of size, errors that name the file, digests.
- ``writing``: Atomic writing, locks, digests.
- ``tables``: Frozen dataclasses as TOML and JSON tables with the unit in each key.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from strapdown.checks import InputError
from strapdown.files.writing import (
    BAGS,
    HDF5,
    TABLES,
    atomic_write,
    json_text,
    locked,
    plain,
    seal,
    set_attributes,
    usable_folder,
    whole_hdf5,
    writable,
    write_json,
    write_text,
)


def library(name: str, what: str, extra: str = "formats") -> Any:
    """Return an optional module; if it is not installed, raise an InputError with its purpose and how to install it."""
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0].replace("_", "-")
        raise InputError(f"{what} needs {package} ({error}); pip install 'strapdown[{extra}]'") from None
