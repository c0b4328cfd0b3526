"""Atomic writing of files: to a temporary file in the same folder, which then replaces the target."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import secrets
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError
from strapdown.files.reading import BLOCK, SEAL, uninterrupted


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str], *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the same folder; on success it replaces ``path``, on any error it is removed.

    The file is new, whatever another user may have put beside ``path``, and has the permissions of what it replaces, else those of the
    umask. If ``durable``, it is flushed to disk before, and its name is always the same: a process that is killed while writing leaves at
    most one such file, which the next write removes; only one process may write then (:func:`locked`).
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    name = f".{target.name}.part" if durable else f".{target.stem}-{secrets.token_hex(8)}{target.suffix}"
    temporary = target.with_name(name)
    if durable:
        temporary.unlink(missing_ok=True)
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield temporary
        if target.is_file() and not target.is_symlink():
            os.chmod(temporary, stat.S_IMODE(target.stat().st_mode))
        if durable:
            with open(temporary, "r+b") as file:
                os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        if error.errno is not None and error.filename is None:  # as of a full disk
            error.filename = os.fspath(target)
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def whole_hdf5(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Yield an HDF5 file in memory; at the end it is written to ``path``, preceded by its digest.

    A full disk then raises an ordinary OSError; the HDF5 library, if interrupted while writing to disk, aborts the program at closing.
    """
    import h5py

    content, versions = io.BytesIO(), ("v110", "v110")  # for attributes above 64 kB
    with uninterrupted(), h5py.File(content, "w", userblock_size=BLOCK, libver=versions) as file:
        yield file
    held = content.getbuffer()
    held[:BLOCK] = _user_block(held[BLOCK:])
    Path(path).write_bytes(held)


@contextlib.contextmanager
def locked(path: str | os.PathLike[str]) -> Iterator[None]:
    """Prevent other processes from writing the same output; if one is writing it already, raise an InputError.

    The lock is a file ``.NAME.lock`` in the folder of the output; it is released when the process ends in any way.
    """
    from filelock import FileLock, Timeout

    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    lock = target.with_name(f".{target.name}.lock")
    try:
        held = FileLock(lock, timeout=0).acquire()
    except Timeout:
        raise InputError(f"{target} is being written by another process; wait for it, or choose another file") from None
    except OSError as error:
        raise InputError(f"{lock} cannot be locked ({error.strerror}); remove it") from None
    with held:
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _user_block(content: bytes | memoryview) -> bytes:
    return (SEAL + hashlib.sha256(content).hexdigest().encode() + b"\n").ljust(BLOCK, b"\0")


def seal(path: str | os.PathLike[str]) -> None:
    """Write a new digest to an HDF5 file of this package that was changed on purpose by another program."""
    with open(path, "r+b") as file:
        content = file.read()
        if not content.startswith(SEAL):
            raise InputError(f"{path} has no digest; only a file written by this version has one")
        file.seek(0)
        file.write(_user_block(content[BLOCK:]))


def set_attributes(node: Any, values: Mapping[str, Any]) -> None:
    """Set attributes of an HDF5 file, group or dataset; strings have a fixed length.

    The HDF5 library stores strings of variable length in a heap, where damage may make it hang.
    """
    import h5py

    for name, value in values.items():
        texts = [value] if isinstance(value, str) else value
        if isinstance(texts, (list, tuple)) and all(isinstance(item, str) for item in texts):
            held = [item.encode("utf-8", "backslashreplace") for item in texts]
            dtype = h5py.string_dtype("utf-8", max((1, *map(len, held))))
            node.attrs.create(name, held[0] if isinstance(value, str) else np.array(held, dtype), dtype=dtype)
        else:
            node.attrs[name] = value


HDF5 = (".h5", ".hdf5")
"""Suffixes of files that hold results completely."""
TABLES = (".csv", ".tsv", ".parquet")
"""Suffixes of the tables that hold a recording completely."""
BAGS = (".bag", ".mcap", ".db3")
FILES = (*HDF5, *TABLES, *BAGS, ".tum", ".json", ".toml", ".html", ".png", ".pdf", ".svg")
"""Suffixes that the name of a new folder must not have: a file was meant."""


def usable_folder(name: str, folder: str | os.PathLike[str]) -> None:
    """Reject a folder to which results cannot be written, before they are computed: one below a file, or without permission."""
    place = Path(folder).absolute()
    while not place.exists():
        place = place.parent
    if not place.is_dir():
        raise InputError(f"{name} cannot be written: {place} is a file; choose another folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"{name} cannot be written: there is no permission to write to {place}; choose another folder")


def writable(
    name: str,
    *paths: str | os.PathLike[str],
    suffixes: tuple[str, ...] = (),
    sources: Sequence[str | os.PathLike[str] | None] = (),
) -> None:
    """Reject output files that cannot be written, before anything is computed.

    A folder in the place of a file, a new folder named like a file, a suffix that is not in ``suffixes``, or a file that is one of the
    ``sources`` that are read.
    """
    for target in map(Path, paths):
        folder = target.parent
        if folder.suffix.lower() in FILES and not folder.exists():
            raise InputError(
                f"{name} is {folder}, but a folder is meant, for {target.name}; name one without a suffix: {folder.with_suffix('')}"
            )
        if target.is_dir():
            raise InputError(f"{name}: {target} is a folder, but a file of that name must be written; choose another")
        if suffixes and target.suffix.lower() not in suffixes:
            raise InputError(f"{name} is {target}, but it is written as {' or '.join(suffixes)}; choose such a suffix")
        for source in sources:
            if source is not None and target.exists() and Path(source).exists() and target.samefile(source):
                raise InputError(f"{name} is {target}, the same file that is read; choose another name")
        usable_folder(name, target.parent)


def plain(value: Any) -> Any:
    """Return a value for JSON: arrays as lists, numbers that are not finite as null."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_text(path: str | os.PathLike[str], text: str, **options: Any) -> None:
    """Write text as UTF-8, atomically; ``options`` are those of :meth:`pathlib.Path.write_text`."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", **options)


def json_text(content: Any) -> str:
    """Return ``content`` as indented JSON; NaN and infinities, which are not part of JSON, are rejected."""
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write ``content`` as indented JSON; NaN and infinities, which are not part of JSON, are rejected."""
    write_text(path, json_text(content))
