"""Compiled functions whose code is kept on disk where it can be, and compiled again where not.

numba's own cache ends a program where no folder can be written, the disk is full or a file is
damaged, and lets two processes that compile at once write over each other. Here it never does.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import stat
import sys
import tempfile
import types
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserWideCacheLocator,
)
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

_DIGEST = hashlib.sha256().digest_size


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return ``numba.njit(**options)`` that keeps the code for other processes.

    It is kept in the first of these folders that can be written: ``NUMBA_CACHE_DIR``,
    ``__pycache__`` beside the source, numba's folder in the user's cache, and a folder of the
    user's own in the temporary folder. Where there is none, or it is full, each process compiles,
    and one line on stderr says so. A file that is damaged or of another source is not used.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if isinstance(dispatcher, Dispatcher):  # NUMBA_DISABLE_JIT gives the function back
            with contextlib.suppress(Exception):  # e.g. no folder at all
                dispatcher._cache = _CodeCache(dispatcher)  # type: ignore[attr-defined]
        return dispatcher

    return compiled


class _PrivateFolder(UserWideCacheLocator):
    """The last resort, which loads code only from a folder that no other user can write."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        super().__init__(function, file)
        self._cache_path = str(private_folder() / self.get_suitable_cache_subpath(file))

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> Any:
        with contextlib.suppress(OSError):
            return super().from_function(function, file)


class _NoFolder(UserWideCacheLocator):
    """Stands for no folder, so that the function is compiled and a line says so."""

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> Any:
        return cls(function, file)

    def ensure_cache_path(self) -> None:
        raise OSError("it cannot be written, nor can the installation or the temporary folder")


class _Locations(CompileResultCacheImpl):
    _locator_classes = [*CompileResultCacheImpl._locator_classes, _PrivateFolder, _NoFolder]


class _CodeCache(FunctionCache):
    """numba's cache of one function, without the ways in which it ends a program."""

    _impl_class = _Locations

    def __init__(self, dispatcher: Dispatcher) -> None:
        super().__init__(dispatcher.py_func)
        self._cache_file = _CodeFiles(Path(self._cache_path), dispatcher)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a damaged or foreign file: it is compiled, and written over
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except Exception as error:
            self.disable()
            _say(
                f"compiled code cannot be kept in {self._cache_path} ({error}); it is compiled in "
                "each process, in about half a minute. Set NUMBA_CACHE_DIR to a folder with room."
            )
        else:
            if self._enabled and isinstance(self._impl.locator, _PrivateFolder):
                _say(
                    f"compiled code is kept in {Path(self._cache_path).parent}, since neither the "
                    "installation nor the home folder can be written. Set NUMBA_CACHE_DIR to keep "
                    "it elsewhere."
                )


class _CodeFiles(IndexDataCacheFile):
    """A file for each compiled version of a function, with a checksum at its end, and no index.

    Its name tells all that the code depends on, so processes that compile at once write either
    the same file or different ones.
    """

    def __init__(self, folder: Path, dispatcher: Dispatcher) -> None:
        self.folder, self.dispatcher = folder, dispatcher
        function = dispatcher.py_func
        tag = sys.implementation.cache_tag
        self.base = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}.{tag}"
        self.base = self.base.replace("<", "").replace(">", "")
        super().__init__(str(folder), self.base, None)

    def path(self, key: Any) -> Path:
        what = hashlib.sha256(repr((numba.__version__, key)).encode()).hexdigest()[:24]
        return self.folder / f"{self.base}.{self.stamp()}.{what}.nbc"

    def stamp(self) -> str:
        """Tell the source by its code, the constants in it and the functions that it calls."""
        digest = hashlib.sha256()
        _read_source(self.dispatcher, digest, set())
        return digest.hexdigest()[:12]

    def load(self, key: Any) -> Any:
        path = self.path(key)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        code, digest = content[:-_DIGEST], content[-_DIGEST:]
        return self._load_data(path.name) if hashlib.sha256(code).digest() == digest else None

    def save(self, key: Any, data: Any) -> None:
        path, code = self.path(key), dumps(data)
        handle, temporary = tempfile.mkstemp(dir=self.folder, suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(code + hashlib.sha256(code).digest())
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
        self.flush(keep=f"{self.base}.{self.stamp()}.")

    def flush(self, keep: str = "\0") -> None:
        for old in self.folder.glob(f"{self.base}.*.nbc"):
            if not old.name.startswith(keep):
                with contextlib.suppress(OSError):
                    old.unlink()


def _read_source(function: Any, digest: Any, seen: set[Any]) -> None:
    """Feed what a function does, and what the functions do that it calls, to a digest."""
    if isinstance(function, Dispatcher):
        digest.update(repr(sorted(function.targetoptions.items())).encode())
        function = function.py_func
    function = getattr(function, "_defn", function)  # an intrinsic's
    if not isinstance(function, types.FunctionType) or function in seen:
        return
    seen.add(function)
    codes = [function.__code__]
    for code in codes:
        constants = [_spelled(part) for part in code.co_consts]
        digest.update(repr((code.co_code, constants, code.co_names, code.co_varnames)).encode())
        codes += [part for part in code.co_consts if isinstance(part, types.CodeType)]
        for value in map(function.__globals__.get, code.co_names):
            if isinstance(value, (bool, int, float, str, tuple, np.generic, np.dtype)):
                digest.update(repr(value).encode())
            else:
                _read_source(value, digest, seen)


def _spelled(constant: Any) -> Any:
    """Spell a constant the same in every process."""
    if isinstance(constant, types.CodeType):
        return constant.co_name
    return sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant


@lru_cache(maxsize=1)
def private_folder() -> Path:
    """Return a folder in the temporary folder that only this user can read and write."""
    user = os.geteuid() if hasattr(os, "geteuid") else "user"
    path = Path(tempfile.gettempdir(), f"torchrl_hmcts-{user}")
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(f"{path} is not a folder.")
    if hasattr(os, "geteuid") and (found.st_uid != os.geteuid() or found.st_mode & 0o077):
        raise PermissionError(f"{path} belongs to somebody else, or others can write it.")
    return path


@lru_cache(maxsize=1)
def _say(line: str) -> None:
    """Say the first such line on stderr, unless the parent of this process says it."""
    if multiprocessing.parent_process() is None:
        print(f"torchrl_hmcts: {line}", file=sys.stderr)
