"""Reading files: all input files, of any format, are opened by this module.

A file may be damaged, of another kind, or malicious. Each format therefore has one function here that opens it, and no other module opens a
file for reading. Every fault of a file is an :class:`~strapdown.checks.InputError` that names the file, raised within :func:`from_file`,
and sizes are checked before memory is allocated.

HDF5 files of this package begin with a block of 512 bytes (a *user block*, which other programs skip) with the SHA-256 digest of the rest
of the file. It is checked before the HDF5 library opens the file, because that library may hang or crash on damaged files. A file without
such a digest is first read by a child process with a time limit. A digest detects damage; it is not a signature and does not authenticate
the author.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import mmap
import multiprocessing
import os
import re
import signal
import stat
import subprocess
import sys
import threading
import tomllib
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError

Name = str | os.PathLike[str]

LIMIT = "STRAPDOWN_MAX_MB"
"""Environment variable: maximum uncompressed size of one file, MB."""
DEFAULT_LIMIT = 4096
TABLE_SHARE = 64
"""Factor by which TOML and JSON must be smaller than the limit: when parsed, they need that much more memory than their text."""
PACKING = 1100
"""Maximum compression ratio of an array; that of deflate is 1032."""
DOTTED_KEYS = 32
"""Maximum number of parts of a dotted key in TOML; the time to parse one grows with the square of that number."""
LONGEST_MESSAGE = 2000

SEAL = b"strapdown file, SHA-256 of the bytes from 512 on: "
"""Beginning of the user block."""
BLOCK = 512
"""Size of the user block, bytes."""


# ------------------------------------------------------------------------------------------------------------------ any file


@contextlib.contextmanager
def from_file(path: Name, kind: str = "") -> Iterator[None]:
    """Raise any exception within as an InputError that blames the file, except for a missing library or a fault in compiling.

    This is the guard around every reader: libraries for foreign formats raise any exception of their parsers. An interruption (Ctrl-C) that
    a library turned into another exception remains one. ``kind`` is the format as which the file is read, for the message.
    """
    handled = sys.exception()
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except InputError as error:
        said = _short(str(error))
        if said == str(error) and Path(path).name in said:
            raise
        raise InputError(said if Path(path).name in said else f"{path}: {said}") from error.__cause__
    except MemoryError:
        raise InputError(f"{path} does not fit into memory; cut it into parts") from None
    except ImportError as error:
        raise InputError(
            f"{path} is not read: a library that strapdown needs is missing or broken ({error}); install strapdown again with pip, which "
            "brings its libraries"
        ) from error
    except BaseException as error:  # a fault inside a library written in Rust is not a subclass of Exception
        if _interrupted(error, handled):
            raise KeyboardInterrupt from error
        if _in_compiler(error) or not (isinstance(error, Exception) or type(error).__module__ == "pyo3_runtime"):
            raise
        text = " ".join(str(error).split())
        what = _short(f"{type(error).__name__}: {text}" if isinstance(error, LookupError) else text)
        said = f"{path} cannot be read {f'as {kind} ' if kind else ''}({what or type(error).__name__})"
        raise InputError(f"{said}; the file is truncated, damaged or of another kind") from error


def _interrupted(error: BaseException | None, handled: BaseException | None) -> bool:
    """Return whether an exception came from an interruption, unless that was ``handled`` already before the file was read."""
    while error is not None and error is not handled:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


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


def limit() -> int:
    """Return the maximum uncompressed size of one file, bytes: 4 GB, or the environment variable ``STRAPDOWN_MAX_MB``."""
    value = os.environ.get(LIMIT, str(DEFAULT_LIMIT))
    if not value.isdecimal() or int(value) == 0:
        raise InputError(f"the environment variable {LIMIT} is {value!r}; it must be a whole number of megabytes")
    return int(value) * 1_000_000


FREELY_UNPACKED = 64_000_000
"""Number of bytes that any file may unpack to."""
USUAL_PACKING = 100
"""Maximum compression ratio of a larger file, unless the user sets a limit: samples of sensors have noise, which hardly compresses."""


class Unpacked:
    """The number of bytes that a packed file of another program may still unpack to, counted before memory is spent."""

    def __init__(self, path: Name, packed: int) -> None:
        """``packed`` is the size of the file, bytes."""
        self.path = path
        self.left = limit() if LIMIT in os.environ else min(limit(), max(FREELY_UNPACKED, USUAL_PACKING * packed))

    def take(self, size: int) -> None:
        """Count bytes that will be unpacked; raise an error if they are too many."""
        if size > self.left:
            raise InputError(
                f"{self.path} unpacks to more than its limit, {self.left / 1e6:.4g} MB left and {size / 1e6:.4g} MB to come; if that is "
                f"intended, set the limit with the environment variable {LIMIT}"
            )
        self.left -= size


@contextlib.contextmanager
def mapped(path: Name) -> Iterator[memoryview]:
    """Yield the content of a regular file, of which only the parts used are brought into memory if it is large."""
    with opened(path) as handle:
        size = os.fstat(handle.fileno()).st_size
        if size < FREELY_UNPACKED:
            yield memoryview(handle.read(size))
        else:
            yield memoryview(mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ))


def existing_file(path: Name) -> None:
    """Reject an input that is missing or not a regular file, such as a folder, a pipe or a device."""
    with opened(path):
        pass


@contextlib.contextmanager
def opened(path: Name, *, link: bool = True, maximum: int | None = None) -> Iterator[io.BufferedReader]:
    """Yield a regular file of at most ``maximum`` bytes (default: :func:`limit`), open for reading.

    If ``link`` is False, a symbolic link is rejected: for a file not named by the user, it could expose another file in the result.
    """
    maximum = limit() if maximum is None else maximum
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
        status = os.fstat(handle.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is not a regular file but a pipe or a device; write its content to a file first")
        _need_size(path, status.st_size, maximum)
        yield handle


def _need_size(path: Name, size: float, maximum: int) -> None:
    if size > maximum:
        raise InputError(
            f"{path} has {size / 1e6:.4g} MB, more than the maximum of {maximum / 1e6:.4g} MB; if that is intended, raise the limit "
            f"with the environment variable {LIMIT} ({limit() // 1_000_000} now)"
        )


def content(path: Name, *, link: bool = True, maximum: int | None = None) -> bytes:
    """Return the bytes of a regular file."""
    with from_file(path), opened(path, link=link, maximum=maximum) as handle:
        maximum = limit() if maximum is None else maximum
        parts, size = [], 0
        # In parts: a buffer of the size asked for is allocated at once. A file may have no stated size (/proc), or grow.
        while part := handle.read(min(maximum + 1, max(os.fstat(handle.fileno()).st_size, 1 << 20))):
            parts.append(part)
            size += len(part)
            _need_size(path, size, maximum)
        return b"".join(parts)


def text(path: Name, *, link: bool = True, maximum: int | None = None) -> str:
    """Return the text of a file in UTF-8."""
    raw = content(path, link=link, maximum=maximum)
    if b"\0" in raw:
        raise InputError(f"{path} cannot be read as text (it has zero bytes); the file is damaged or of another kind")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} cannot be read as text ({error}); write it in UTF-8") from None


# ------------------------------------------------------------------------------------------------------------ TOML, JSON, NPY

_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DOTTED = re.compile(rf"(?<![\w-])(?:{_PART}[ \t]*+\.[ \t]*+){{{DOTTED_KEYS}}}")


def from_toml(content: str, place: str) -> dict[str, Any]:
    """Return the table of a TOML text; ``place`` is its name in errors."""
    if _DOTTED.search(content):
        raise InputError(f"{place} has a key of more than {DOTTED_KEYS} parts joined by dots; it is of another kind")
    try:
        return tomllib.loads(content)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise InputError(f"{place} is not TOML ({_short(str(error))})") from None


def toml(path: Name) -> dict[str, Any]:
    """Return the table of a TOML file."""
    return from_toml(text(path, maximum=limit() // TABLE_SHARE), str(path))


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
    return from_json(text(path, maximum=limit() // TABLE_SHARE), str(path))


def npy(path: Name) -> np.ndarray[Any, Any]:
    """Return the array of an NPY file, whose size must be that declared in its header; objects (pickles) are rejected."""
    with from_file(path), opened(path) as handle:
        version = np.lib.format.read_magic(handle)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(handle)
        declared = functools.reduce(lambda a, b: a * b, shape, dtype.itemsize)
        held = os.fstat(handle.fileno()).st_size - handle.tell()
        if dtype.hasobject or declared != held:
            raise ValueError(f"its header declares {declared} bytes of {dtype}, but {held} follow")
        handle.seek(0)
        return np.lib.format.read_array(handle, allow_pickle=False)


# ---------------------------------------------------------------------------------------------------------------------- HDF5


@contextlib.contextmanager
def hdf5(path: Name) -> Iterator[Any]:
    """Yield an HDF5 file, open for reading, that is complete and self-contained, with at most :func:`limit` bytes uncompressed.

    A file is rejected if it does not match its digest, makes the HDF5 library hang or crash, refers to other files (external links, virtual
    datasets, external storage), or declares more data than it contains.
    """
    import h5py

    with from_file(path):
        sealed = has_digest(path)
        if not is_hdf5(path):
            raise InputError(
                f"{path} cannot be read as HDF5 (it has no signature); the file is truncated or of another kind"
            )
        if not sealed:
            _need_readable(path)
        with uninterrupted(), h5py.File(path, "r") as file:
            if not sealed and str(attributes(file).get("kind", "")).startswith("strapdown "):
                raise InputError(f"{path} is damaged: its digest is missing; make it again, or restore a copy")
            _need_plain(path, file)
            yield file


def is_hdf5(path: Name) -> bool:
    """Return whether a file has the signature of HDF5, at its beginning or after a user block."""
    with opened(path) as handle:
        place, size = 0, os.fstat(handle.fileno()).st_size
        while place < size:
            handle.seek(place)
            if handle.read(8) == b"\x89HDF\r\n\x1a\n":
                return True
            place = max(BLOCK, 2 * place)
    return False


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
    kinds = {h5py.h5l.TYPE_EXTERNAL: "an external link", h5py.h5l.TYPE_SOFT: "a soft link"}
    for name, kind in links:
        if kind != h5py.h5l.TYPE_HARD:
            place = f"{path}: {name.decode(errors='replace')}"
            raise InputError(f"{place} is {kinds.get(kind, 'a link')}, which is not followed; store the data itself")
    total = 0
    for name, _ in links:
        dataset = file[name]
        if not isinstance(dataset, h5py.Dataset):
            continue
        place = f"{path}: {name.decode(errors='replace')}"
        if dataset.is_virtual or dataset.external:
            raise InputError(f"{place} is stored in other files, which are not read; store the data there")
        declared, held = (dataset.size or 0) * dataset.dtype.itemsize, dataset.id.get_storage_size()
        if declared > max(PACKING * held, 65536):
            raise InputError(
                f"{place} declares {declared / 1e6:.4g} MB, but the file has {held / 1e6:.3g} MB of it; it is damaged or of another kind"
            )
        total += declared
    _need_size(path, total, limit())


def _need_readable(path: Name) -> None:
    """Reject a file on which the HDF5 library hangs or crashes, by reading it in a child process first."""
    status = os.stat(path)
    fault = _fault_of_child(os.fspath(path), status.st_ino, status.st_size, status.st_mtime_ns)
    if fault:
        raise InputError(f"{path} is damaged: the HDF5 library {fault}; restore a copy, or make it again")


@functools.lru_cache(maxsize=64)
def _fault_of_child(path: str, *identity: int) -> str:
    seconds = 2 + identity[1] // 20_000_000
    # A fork is fast, because all modules are imported. With other threads it could deadlock: a lock held by one would never be released.
    alone = sys.platform == "linux" and threading.active_count() == 1
    status = _status_of_fork(path, seconds) if alone else _status_of_process(path, seconds)
    if status is None or status in (-9, -24):  # SIGKILL and SIGXCPU, sent by the limits of :func:`probe`
        return "does not come to an end"
    return "crashes on it" if status < 0 else ""


def _status_of_fork(path: str, seconds: int) -> int | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about idle threads of libraries, such as OpenBLAS
        child = multiprocessing.get_context("fork").Process(target=_silent_probe, args=(path, seconds))
        child.start()
    child.join(30 * seconds)
    if child.exitcode is None:
        child.kill()
    return child.exitcode


def _silent_probe(path: str, seconds: int) -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(null, stream)
    with contextlib.suppress(Exception):
        probe(path, seconds)


def _status_of_process(path: str, seconds: int) -> int | None:
    # If Python is frozen into a program, or h5py is missing in the child, it ends with another status, and the file is read here.
    child = "import sys; sys.path[:0] = [sys.argv[1]]; from strapdown.files import reading; reading.probe(sys.argv[2], int(sys.argv[3]))"
    command = [sys.executable, "-c", child, str(Path(__file__).parents[2]), path, str(seconds)]
    try:
        done = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, timeout=30 * seconds, check=False)
    except subprocess.TimeoutExpired:
        return None
    return done.returncode


def probe(path: str, seconds: int) -> None:
    """Read all of an HDF5 file, with limits of time and memory on the process; run in the child process of :func:`hdf5`."""
    import h5py

    with contextlib.suppress(ImportError, ValueError, OSError):  # Windows has no such limits
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_DATA, (limit() + 1_000_000_000,) * 2)
    with h5py.File(path, "r") as file:
        _need_plain(path, file)
        nodes = [file]
        file.visititems(lambda name, node: nodes.append(node))
        for node in nodes:
            with contextlib.suppress(Exception):
                attributes(node)
            if isinstance(node, h5py.Dataset) and node.chunks:
                with contextlib.suppress(Exception):
                    for part in node.iter_chunks():
                        node[part]


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

    if name not in group:
        raise InputError(f"{place(group, name)} is missing; the file is damaged, make it again")
    node = group[name]
    if isinstance(node, h5py.Group):
        raise InputError(f"{place(group, name)} is a group and not an array; the file is damaged, make it again")
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "fiub" or node.shape is None:
        raise InputError(f"{place(group, name)} is not an array of numbers; the file is damaged, make it again")
    return np.asarray(node[()])
