"""``njit`` for the kernels of this package: compiled code is kept on disk under what it is compiled from.

Numba's own cache looks at the file of a kernel alone, and at its date: a kernel whose callee has changed would run as it was. Here a kernel's
cache folder is named by the contents of its module and of all modules of this package that the module imports, directly or not. So a change of a
kernel compiles again what calls it, and a change of anything else compiles nothing. Two checkouts with the same kernels share one cache.

Within the folder each compiled signature is one file, named by the types of the arguments, with the fields of named tuples and the source of
functions that are passed as arguments. So processes that compile at the same time cannot mix up their results.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import os
import re
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, types

from ctr_dynamics.kernels.callees import call_without_machine_code

PACKAGE = Path(__file__).resolve().parents[1]
KEPT_DAYS = 30.0  # caches that nobody has used for so long are removed


class KernelsNotKept(RuntimeWarning):
    """Compiled kernels cannot be stored."""


_FOLDER = re.compile(r"ctr_dynamics\..+-[0-9a-f]{16}")


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


def _package_of(path: Path) -> list[str]:
    """Dotted parts of the package that the module at ``path`` lies in; empty outside this package."""
    return [PACKAGE.name, *path.parent.relative_to(PACKAGE).parts] if path.is_relative_to(PACKAGE) else []


@functools.cache
def _imported(path: Path) -> frozenset[Path]:
    """Files of this package that the module at ``path`` imports itself, outside of functions: compiled functions cannot import."""
    found = set()
    waiting: list[ast.stmt] = ast.parse(path.read_bytes()).body
    while waiting:
        node = waiting.pop()
        names: list[str] = []
        if isinstance(node, (ast.If, ast.Try)):
            waiting += [*node.body, *node.orelse, *getattr(node, "finalbody", [])]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            within = _package_of(path)
            above = within[: len(within) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        for name in names:
            parts = name.split(".")
            if parts[0] == PACKAGE.name:
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


def _remove_unused(folder: Path) -> None:
    """Remove the cache folders beside ``folder`` that nobody has used for ``KEPT_DAYS``."""
    limit = time.time() - KEPT_DAYS * 86400.0
    for other in folder.parent.iterdir():
        try:
            if _FOLDER.fullmatch(other.name) and other != folder and other.stat().st_mtime < limit:
                shutil.rmtree(other, ignore_errors=True)
        except OSError:
            continue  # another process removes it too


@functools.cache
def _note_use(folder: Path) -> None:
    """Date the folder by its use, as :func:`_remove_unused` reads it."""
    try:
        if folder.stat().st_mtime < time.time() - 86400.0:
            os.utime(folder)
    except OSError:
        pass  # of another user, or read-only


def _described(kind: Any) -> str:
    """A type of an argument, by everything that compiled code depends on."""
    if isinstance(kind, types.Dispatcher):
        function = kind.dispatcher.py_func
        return f"{source_digest(Path(function.__code__.co_filename).resolve())}:{function.__qualname__}"
    if isinstance(kind, types.BaseTuple):
        parts = ", ".join(map(_described, getattr(kind, "types", ())))
        named = getattr(kind, "instance_class", None)
        name = "" if named is None else f"{named.__module__}.{named.__qualname__}{named._fields}"
        return f"{name}({parts})"
    return str(kind)


@functools.cache
def _say_not_kept(folder: Path, reason: str) -> None:
    """Warn once that what is compiled is lost at the end of the process."""
    warnings.warn(
        f"compiled kernels cannot be kept in {folder} ({reason}): every start compiles them again; "
        "set NUMBA_CACHE_DIR to a folder that can be written",
        KernelsNotKept,
        stacklevel=2,
    )


class _Files(caching.IndexDataCacheFile):
    """Compiled code of one kernel: a file for each key and no index; written whole or not at all."""

    def _name(self, key: str) -> str:
        return f"{self._filename_base}.{key}.nbc"

    def __init__(self, folder: Path, filename_base: str, digest: str) -> None:
        super().__init__(str(folder), filename_base, digest)
        self._folder, self._filename_base = folder, filename_base

    def load(self, key: str) -> Any:
        """What is stored under ``key``; None without it, or where it cannot be read."""
        try:
            data = self._load_data(self._name(key))
        except Exception:  # absent, or damaged: reading raises whatever the bytes lead to
            return None
        _note_use(self._folder)
        return data

    def save(self, key: str, data: Any) -> None:
        """Store it; a folder that cannot be written is said once, and computing goes on."""
        try:
            new = not self._folder.is_dir()
            self._folder.mkdir(parents=True, exist_ok=True)
            self._save_data(self._name(key), data)
        except OSError as error:
            _say_not_kept(cache_folder(), error.strerror or str(error))
            return
        if new:
            _remove_unused(self._folder)

    def flush(self) -> None:
        """Remove everything that is stored of this kernel."""
        for path in self._folder.glob(f"{self._filename_base}.*.nbc"):
            path.unlink(missing_ok=True)


class _Locator:
    """What numba asks of the place of a kernel's compiled code."""

    def __init__(self, folder: Path, digest: str, line: int) -> None:
        self._folder, self._digest, self._line = folder, digest, line

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)

    def ensure_cache_path(self) -> None:
        """Nothing: the folder is made when something is stored in it."""


class _CacheContents(caching.FunctionCache._impl_class):  # type: ignore[misc, valid-type]
    """Numba's way to write a compiled function, with the package's own place for it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        file = Path(function.__code__.co_filename).resolve()
        digest = source_digest(file)
        name = file.relative_to(PACKAGE) if file.is_relative_to(PACKAGE) else Path(file.name)
        stem = ".".join(("ctr_dynamics", *name.with_suffix("").parts))
        self._lineno = function.__code__.co_firstlineno
        self._locator = _Locator(cache_folder() / f"{stem}-{digest}", digest, self._lineno)
        self._filename_base = self.get_filename_base(function.__qualname__, getattr(sys, "abiflags", ""))


class _KernelCache(caching.FunctionCache):
    _impl_class = _CacheContents

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Files(
            Path(self._cache_path), self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    def _index_key(self, sig: Any, codegen: Any) -> str:
        """Name of the file of this signature, on this processor."""
        result = _described(sig.return_type) if hasattr(sig, "args") else ""
        kinds = [_described(kind) for kind in getattr(sig, "args", sig)]
        text = repr((kinds, result, codegen.magic_tuple()))
        return hashlib.sha256(text.encode()).hexdigest()[:24]


def njit(*, cache: bool = True, large: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """:func:`numba.njit` with the cache of this module, for functions that call each other (:mod:`ctr_dynamics.kernels.callees`).

    What a cached kernel uses stands in its module or in one that it imports.

    Args:
        cache: False compiles in every process.
        large: whether callers of the function are left to the outermost kernel, with which they are optimised.
        options: of numba.

    Raises:
        TypeError: the function is a closure or has other globals than its module: the cache would not see what it is made of.
    """
    options["no_cfunc_wrapper"] = True  # nobody calls them from C

    def decorate(function: Callable[..., Any]) -> Any:
        compiled = numba.njit(**options)(function)
        call_without_machine_code(compiled, function, options, large)
        if cache and Path(function.__code__.co_filename).is_file():
            module = sys.modules.get(function.__module__)
            if function.__closure__ or (module is not None and function.__globals__ is not vars(module)):
                raise TypeError(
                    f"{function.__qualname__} uses more than its module holds; compile it with cache=False"
                )
            compiled._cache = _KernelCache(function)
        return compiled

    return decorate
