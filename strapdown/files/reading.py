"""Reading files: all input files, of any format, are opened by this module.

A file may be damaged, of another kind, or malicious. Each format therefore has one function here that opens it, and no other module opens a
file for reading. Every fault of a file is an :class:`~strapdown.checks.InputError` that names the file, raised within :func:`from_file`,
and what a packed file declares is checked before memory is allocated.

HDF5 files of this package begin with a block of 512 bytes (a *user block*, which other programs skip) with the SHA-256 digest of the rest
of the file. It is checked before the HDF5 library opens the file, because that library may hang or crash on damaged files. A digest detects
damage; it is not a signature and does not authenticate the author.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import signal
import stat
import threading
import tomllib
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError

Name = str | os.PathLike[str]

FREELY_UNPACKED = 256_000_000
"""Number of bytes that any file may unpack to."""
PACKING = 100
"""Maximum compression ratio of a larger file: samples of sensors have noise, which hardly compresses."""
ARRAY_PACKING = 1100
"""Maximum compression ratio of an array; that of deflate is 1032."""
LONGEST_MESSAGE = 2000

SEAL = b"strapdown file, SHA-256 of the bytes from 512 on: "
"""Beginning of the user block."""
BLOCK = 512
"""Size of the user block, bytes."""
HDF5 = b"\x89HDF\r\n\x1a\n"
"""Signature of HDF5, at the beginning of a file or after its user block."""


# ------------------------------------------------------------------------------------------------------------------ any file


@contextlib.contextmanager
def from_file(path: Name, kind: str = "") -> Iterator[None]:
    """Raise any exception within as an InputError that blames the file, except for a missing library or a fault in compiling.

    This is the guard around every reader: libraries for foreign formats raise any exception of their parsers. ``kind`` is the format as
    which the file is read, for the message.
    """
    try:
        yield
    except InputError as error:
        message = _short(str(error))
        if message == str(error) and Path(path).name in message:
            raise
        raise InputError(message if Path(path).name in message else f"{path}: {message}") from error.__cause__
    except MemoryError:
        raise InputError(f"{path} does not fit into memory; cut it into parts") from None
    except ImportError:
        raise
    except BaseException as error:
        panic = type(error).__module__ == "pyo3_runtime"  # of a library written in Rust; no subclass of Exception
        if _in_compiler(error) or not (isinstance(error, Exception) or panic):
            raise
        text = " ".join(str(error).split())
        what = _short(f"{type(error).__name__}: {text}" if isinstance(error, LookupError) else text)
        message = f"{path} cannot be read {f'as {kind} ' if kind else ''}({what or type(error).__name__})"
        raise InputError(f"{message}; the file is truncated, damaged or of another kind") from error


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Defer Ctrl-C to the end: interrupted within the HDF5 library, finalizers may free memory twice."""
    if threading.current_thread() is not threading.main_thread() or not callable(signal.getsignal(signal.SIGINT)):
        yield
        return
    signals: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: signals.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if signals:
            signal.raise_signal(signal.SIGINT)


def _in_compiler(error: BaseException) -> bool:
    """Return whether an exception was raised while a kernel was compiled, for which no file is to blame."""
    modules = (frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(name.partition(".")[0] in ("numba", "llvmlite") for name in modules)


def _short(text: str) -> str:
    """Return a message, shortened in the middle if it is too long, as a malicious file may make it."""
    half = LONGEST_MESSAGE // 2
    return text if len(text) <= LONGEST_MESSAGE else f"{text[:half]} … {text[-half:]}"


def need_room(path: Name, size: float) -> None:
    """Reject a packed file that unpacks to this number of bytes if that is far more than its samples can have been packed by."""
    packed = os.path.getsize(path)
    if size > max(FREELY_UNPACKED, PACKING * packed):
        raise InputError(
            f"{path} has {packed / 1e6:.3g} MB and unpacks to {size / 1e6:.4g} MB, as no recording does; write it without compression"
        )


def existing_file(path: Name) -> None:
    """Reject an input that is missing or not a regular file, such as a folder, a pipe or a device."""
    with opened(path):
        pass


@contextlib.contextmanager
def opened(path: Name, *, link: bool = True) -> Iterator[io.BufferedReader]:
    """Yield a regular file, open for reading.

    If ``link`` is False, a symbolic link is rejected: for a file not named by the user, it could expose another file in the result.
    """
    if not link and Path(path).is_symlink():
        raise InputError(f"{path} is a symbolic link, which is not followed here; put the file itself there")
    try:
        # Non-blocking, so that a pipe without a writer is opened and then rejected.
        opener = lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0))  # noqa: E731
        handle = open(path, "rb", opener=opener)  # noqa: SIM115
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; check the path") from None
    except (OSError, ValueError) as error:
        if Path(path).is_dir():
            raise InputError(f"{path} is a folder; name the file in it") from None
        raise InputError(f"{path} cannot be read ({error}); check the path and its permissions") from None
    with handle:
        if not stat.S_ISREG(os.fstat(handle.fileno()).st_mode):
            raise InputError(f"{path} is not a regular file but a pipe or a device; write its content to a file first")
        yield handle


def content(path: Name, *, link: bool = True) -> bytes:
    """Return the bytes of a regular file."""
    with from_file(path), opened(path, link=link) as handle:
        return handle.read()


def text(path: Name, *, link: bool = True) -> str:
    """Return the text of a file in UTF-8."""
    raw = content(path, link=link)
    if b"\0" in raw:
        words = (
            "write it in UTF-8, not UTF-16"
            if raw[:2] in (b"\xff\xfe", b"\xfe\xff")
            else "the file is damaged or of another kind"
        )
        raise InputError(f"{path} cannot be read as text (it has zero bytes); {words}")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} cannot be read as text ({error}); write it in UTF-8") from None


# ------------------------------------------------------------------------------------------------------------ TOML, JSON, NPY


def from_toml(content: str, place: str) -> dict[str, Any]:
    """Return the table of a TOML text; ``place`` is its name in errors."""
    try:
        return tomllib.loads(content)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise InputError(f"{place} is not TOML ({_short(str(error))})") from None


def toml(path: Name) -> dict[str, Any]:
    """Return the table of a TOML file."""
    return from_toml(text(path), str(path))


def from_json(content: str, place: str) -> Any:
    """Return the content of a JSON text; NaN and infinities, which are not part of JSON, are rejected."""

    def refuse(word: str) -> Any:
        raise ValueError(f"it has {word}")

    try:
        return json.loads(content, parse_constant=refuse)
    except (RecursionError, ValueError) as error:
        raise InputError(f"{place} is not JSON ({_short(str(error))}); it is truncated or of another kind") from None


def json_file(path: Name) -> Any:
    """Return the content of a JSON file."""
    return from_json(text(path), str(path))


def npy(path: Name) -> np.ndarray[Any, Any]:
    """Return the array of an NPY file; objects (pickles) are rejected."""
    with from_file(path), opened(path) as handle:
        return np.lib.format.read_array(handle, allow_pickle=False)


# ---------------------------------------------------------------------------------------------------------------------- HDF5


@contextlib.contextmanager
def hdf5(path: Name) -> Iterator[Any]:
    """Yield an HDF5 file, open for reading, that is complete and self-contained.

    A file is rejected if it does not match its digest, refers to other files (external links, virtual datasets, external storage), or
    declares more data than it contains.
    """
    import h5py

    with from_file(path):
        sealed = has_digest(path)
        if not is_hdf5(path):
            raise InputError(
                f"{path} cannot be read as HDF5 (no signature), the format of records and results; it is truncated or of another kind, as "
                "a recording (for `strapdown estimate`) or a table of attitudes (for `strapdown check`)"
            )
        with uninterrupted(), h5py.File(path, "r") as file:
            if not sealed and str(attributes(file).get("kind", "")).startswith("strapdown "):
                raise InputError(f"{path} is damaged: its digest is missing; make it again, or restore a copy")
            _need_plain(path, file)
            yield file


def is_hdf5(path: Name) -> bool:
    """Return whether a file has the signature of HDF5."""
    with opened(path) as handle:
        head = handle.read(BLOCK + len(HDF5))
    return HDF5 in (head[: len(HDF5)], head[BLOCK:])


def kind(path: Name) -> str:
    """Return the kind of an HDF5 file of this package, such as "strapdown estimate"; empty for any other file or folder."""
    if Path(path).is_dir() or not is_hdf5(path):
        return ""
    with hdf5(path) as file:
        name = str(attributes(file).get("kind", ""))
    return name if name.startswith("strapdown ") else ""


def has_digest(path: Name) -> bool:
    """Return whether a file begins with a digest; if the digest does not match the rest of the file, it is rejected."""
    with opened(path) as handle:
        block = handle.read(BLOCK)
        if not block.startswith(SEAL):
            return False
        digest = hashlib.file_digest(handle, "sha256").hexdigest()
    if block.removeprefix(SEAL)[:64] != digest.encode():
        raise InputError(
            f"{path} cannot be read: its content does not match its digest, so it is damaged or truncated; restore a copy, or make it "
            "again (if you changed it on purpose, strapdown.files.seal writes a new digest)"
        )
    return True


def _need_plain(path: Name, file: Any) -> None:
    """Reject an HDF5 file that refers to other files, or declares more data than it contains."""
    import h5py

    links: list[tuple[bytes, int]] = []
    file.id.links.visit(lambda name, link: links.append((name, link.type)), info=True)
    total = 0
    for name, kind in links:
        place = f"{path}: {name.decode(errors='replace')}"
        if kind != h5py.h5l.TYPE_HARD:
            raise InputError(f"{place} is a link, which is not followed; store the data itself")
        dataset = file[name]
        if not isinstance(dataset, h5py.Dataset):
            continue
        if dataset.is_virtual or dataset.external:
            raise InputError(f"{place} is stored in other files, which are not read; store the data there")
        declared, stored = (dataset.size or 0) * dataset.dtype.itemsize, dataset.id.get_storage_size()
        if declared > max(ARRAY_PACKING * stored, 65536):
            raise InputError(
                f"{place} declares {declared / 1e6:.4g} MB, but the file has {stored / 1e6:.3g} MB of it; it is damaged or of another kind"
            )
        total += declared
    need_room(path, total)


def attributes(node: Any) -> dict[str, Any]:
    """Return the attributes of an HDF5 file, group or dataset as Python strings, numbers and lists."""
    return {name: _plain(value) for name, value in node.attrs.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")  # another program may use another encoding
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist()) if value.dtype.kind in "SO" else value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list) else value


def place(group: Any, name: str) -> str:
    """Return the file and the path of a member of an HDF5 group, for messages."""
    return f"{group.file.filename}: {f'{group.name}/{name}'.lstrip('/')}"


def numbers(group: Any, name: str) -> np.ndarray[Any, Any]:
    """Return an array of numbers of an HDF5 group."""
    import h5py

    node = group.get(name)
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "fiub" or node.shape is None:
        what = "missing" if node is None else "not an array of numbers"
        raise InputError(f"{place(group, name)} is {what}; the file is damaged, make it again")
    return np.asarray(node[()])
