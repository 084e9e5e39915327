"""``njit`` for the kernels of this package: compiled code is kept on disk under what it is compiled from.

Numba's own cache looks at the file of a kernel alone, and at its date; a kernel whose callee has changed would run as it was. Here a kernel's
cache is named by the contents of its module and of all modules of this package that the module imports, directly or not. So a change of a kernel
compiles again what calls it, and a change of anything else compiles nothing. Two checkouts with the same kernels share one cache.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

PACKAGE = Path(__file__).resolve().parents[1]
KEPT_DAYS = 30.0  # caches of other versions of a kernel that nobody has used for so long are removed


@functools.cache
def cache_folder() -> Path:
    """Folder of the compiled kernels.

    ``NUMBA_CACHE_DIR`` if it is set, else ``numba-cache`` in the environment that ``make`` has made, else ``~/.cache/ctr_dynamics``.
    """
    made = Path(sys.prefix) / "numba-cache"
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given)
    if os.access(made, os.W_OK):
        return made
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "ctr_dynamics"


@functools.cache
def _imported(path: Path) -> frozenset[Path]:
    """Files of this package that the module at ``path`` imports itself."""
    found = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            parts = name.split(".")
            if parts[0] != PACKAGE.name:
                continue
            file = PACKAGE.joinpath(*parts[1:]).with_suffix(".py")
            if file.is_file():
                found.add(file)
    return frozenset(found)


@functools.cache
def source_digest(path: Path) -> str:
    """Hash of what the kernels of the module at ``path`` are compiled from: its text and that of every module of this package below it."""
    reached, waiting = set(), [path]
    while waiting:
        file = waiting.pop()
        if file not in reached:
            reached.add(file)
            waiting.extend(_imported(file))
    digest = hashlib.sha256(numba.__version__.encode())
    for file in sorted(reached):
        digest.update(os.path.relpath(file, PACKAGE).encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _remove_old(folder: Path) -> None:
    """Remove caches of earlier versions of a module beside its new ``folder``."""
    limit = time.time() - KEPT_DAYS * 86400.0
    stem = folder.name.rpartition("-")[0]
    for other in folder.parent.glob(f"{stem}-*"):
        try:
            if other.name.rpartition("-")[0] == stem and other != folder and other.stat().st_mtime < limit:
                shutil.rmtree(other, ignore_errors=True)
        except OSError:
            continue  # another process removes it too


class _Locator:
    """Where numba keeps the compiled code of one kernel, and what tells that it is still of use."""

    def __init__(self, function: Callable[..., Any]) -> None:
        file = Path(function.__code__.co_filename).resolve()
        self._py_file = str(file)
        self._line = function.__code__.co_firstlineno
        self._stamp = source_digest(file)
        name = os.path.relpath(file, PACKAGE) if file.is_relative_to(PACKAGE) else file.name
        stem = name.removesuffix(".py").replace(os.sep, ".")
        self._folder = cache_folder() / f"{stem}-{self._stamp}"

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)

    def ensure_cache_path(self) -> None:
        new = not self._folder.is_dir()
        self._folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=self._folder).close()  # it must be writable
        if new:
            _remove_old(self._folder)


class _CacheContents(caching.FunctionCache._impl_class):  # type: ignore[misc, valid-type]
    """Numba's way to write a compiled function, with the package's own place for it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._locator = _Locator(function)
        self._filename_base = self.get_filename_base(function.__qualname__, getattr(sys, "abiflags", ""))


class _KernelCache(caching.FunctionCache):
    _impl_class = _CacheContents


def njit(*, cache: bool = True, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """:func:`numba.njit` with the cache of this module.

    Raises:
        OSError: the cache's folder cannot be written (when something is compiled).
    """

    def decorate(function: Callable[..., Any]) -> Any:
        compiled = numba.njit(**options)(function)
        if cache:
            compiled._cache = _KernelCache(function)
        return compiled

    return decorate
