"""Writing files so that a reader never sees half of one: written beside, then renamed over."""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from strapdown.checks import InputError


@contextlib.contextmanager
def written_beside(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path in the same folder; on success it replaces ``path``, on any error it is removed.

    Missing parent folders are made. The suffix is kept, so that writers which look at it (matplotlib) are content.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        os.chmod(temporary, 0o644)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def whole_hdf5(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Yield an HDF5 file in memory; at the end its bytes go to ``path`` as those of any file.

    A disk that is full is then an ordinary OSError: HDF5 itself, stopped in the middle of a write, ends the whole program when it closes.
    """
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        yield file
    Path(path).write_bytes(content.getbuffer())


def existing_file(path: str | os.PathLike[str]) -> None:
    """Refuse an input that is not there, or is a folder, before a library says so in its own words."""
    if Path(path).is_dir():
        raise InputError(f"{path} is a folder; name the file in it")
    if not Path(path).exists():
        raise InputError(f"{path} does not exist; check the path")


def usable_folder(name: str, folder: str | os.PathLike[str]) -> None:
    """Refuse a folder that results cannot go to, before they are computed: one below a file, or that may not be written.

    Nothing is made; the folder appears with the first file written.
    """
    place = Path(folder).absolute()
    while not place.exists():
        place = place.parent
    if not place.is_dir():
        raise InputError(f"{name} is {folder}, but {place} is a file; choose another folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"{name} is {folder}, but {place} may not be written; choose another folder")


def output_file(
    name: str, path: str | os.PathLike[str], suffixes: tuple[str, ...], *sources: str | os.PathLike[str]
) -> None:
    """Refuse an output file of another kind than its suffix says, or one that would replace a file that is read."""
    target = Path(path)
    if target.suffix.lower() not in suffixes:
        raise InputError(f"{name} is {target}, but what is written is {' or '.join(suffixes)}; choose such a suffix")
    for source in sources:
        if target.exists() and Path(source).exists() and target.samefile(source):
            raise InputError(f"{name} is {target}, the very file that is read; choose another name")
    usable_folder(name, target.parent)


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write ``content`` as indented JSON; NaN and infinities are refused because JSON has no word for them."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"  # before any folder is made
    with written_beside(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
