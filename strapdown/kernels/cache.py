"""The disk cache of compiled kernels: entries that are checked before they are loaded, and faults that never end a run.

An entry is one file: the SHA-256 digest of the rest, and the pickle of numba's compile result. Its name has a digest of everything that it
depends on, so there is no index that could be damaged. numba's own cache loads whatever it finds: a damaged entry then raises any exception
of pickle, and changed machine code crashes the process.

A damaged entry is deleted and compiled again; an entry that cannot be written, as on a full disk, is left out. Both are reported once per
process, as a :class:`CacheWarning`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import platform
import secrets
import sys
import warnings
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

DIGEST = hashlib.sha256().digest_size
"""Size of the digest at the beginning of an entry, bytes."""


class CacheWarning(UserWarning):
    """An entry of the cache was damaged, or cannot be written; the kernel is compiled instead."""


class KernelCache(FunctionCache):  # type: ignore[misc]
    """The entries of one kernel, whose ``name`` includes the modules bound to it; ``sources``: digest of all that it is compiled from."""

    _warned = False

    def __init__(self, function: Any, name: str, sources: str) -> None:
        super().__init__(function)
        file_name = "".join(c if c.isalnum() or c in "._" else "_" for c in f"{function.__module__}.{name}")
        self._prefix = f"{file_name}.{sys.implementation.cache_tag}"
        self._sources = sources
        self._depends_on = (numba.__version__, platform.python_version(), sources, name)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compile result of a signature; None if there is no entry, or only a damaged one."""
        # Without numba's own target.refresh(), which imports everything that compilation may need, also SciPy's linear algebra.
        entry = self._entry(signature, target.codegen())
        try:
            with open(entry, "rb") as file:
                digest, content = file.read(DIGEST), file.read()
        except OSError:
            return None
        if hashlib.sha256(content).digest() == digest:
            with contextlib.suppress(Exception):
                return self._impl.rebuild(target, pickle.loads(content))
        self._warn(f"a compiled kernel in {entry.parent} is damaged: it is discarded and compiled again")
        with contextlib.suppress(OSError):
            entry.unlink()
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Write the compile result of a signature, and delete the entries of earlier versions of the kernels."""
        if not self._impl.check_cachable(result):
            return
        content = dumps(self._impl.reduce(result))
        entry = self._entry(signature, result.codegen)
        try:
            entry.parent.mkdir(parents=True, exist_ok=True)
            temporary = entry.with_name(f"{entry.stem}-{secrets.token_hex(8)}")
            handle = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0), 0o666)
            try:
                with open(handle, "wb") as file:
                    file.write(hashlib.sha256(content).digest() + content)
                os.replace(temporary, entry)
            finally:
                temporary.unlink(missing_ok=True)
            for other in entry.parent.glob(f"{self._prefix}-*"):
                if not other.name.startswith(f"{self._prefix}-{self._sources[:8]}-"):
                    other.unlink(missing_ok=True)
        except OSError as error:
            self._warn(f"compiled kernels cannot be stored ({error}): they are compiled anew in each process")

    def _entry(self, signature: Any, codegen: Any) -> Path:
        key = hashlib.sha256(repr((self._index_key(signature, codegen), self._depends_on)).encode()).hexdigest()
        return Path(self.cache_path) / f"{self._prefix}-{self._sources[:8]}-{key[:32]}.kernel"

    @classmethod
    def _warn(cls, words: str) -> None:
        if not cls._warned:
            KernelCache._warned = True
            warnings.warn(words, CacheWarning, stacklevel=2)
