"""Files that are written: whole or not at all, never over a file that is read, and said before the work where they cannot be."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ctr_dynamics.errors import InputError

DEVICES = "/dev/"


def _is_device(path: Path) -> bool:
    """Whether ``path`` is to be written into, not replaced: a device, a pipe, and /dev/stdout whatever stands behind it."""
    return str(path.absolute()).startswith(DEVICES) or (path.exists() and not path.is_file())


def check_target(path: Path, what: str = "") -> None:
    """Reject a file that could not be written, before the work.

    Args:
        path: of the file.
        what: the option or parameter that names it, for the message.

    Raises:
        InputError: it is a folder, its folder does not exist, or it cannot be written.
    """
    where = f"{what} '{path}'" if what else str(path)
    if path.is_dir():
        raise InputError("is a folder, a file name is expected", where=where)
    if not path.absolute().parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist", where=where, do="create it first")
    if not os.access(path if path.exists() else path.absolute().parent, os.W_OK):
        raise InputError("cannot be written (no permission)", where=where, do="name another file")


def check_folder(path: Path) -> Path:
    """The folder ``path``, which can be made or written to when there is something to write: said before the work, and nothing is left of none.

    Raises:
        InputError: it or a folder above it is a file, or there is no permission.
    """
    above = next(folder for folder in (path, *path.parents) if folder.exists())
    if not above.is_dir():
        raise InputError("is a file, a folder is expected", where=str(above), do="name another")
    if not os.access(above, os.W_OK):
        raise InputError("cannot be written to (no permission)", where=str(above), do="name another folder")
    return path


def output_folder(path: Path) -> Path:
    """The folder ``path``, made where it does not exist.

    Raises:
        InputError: it is a file, or cannot be made or written to.
    """
    check_folder(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", where=str(path), do="name another") from None
    return path


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`, renamed to it on success and removed on any failure.

    A link stays one: the file that it leads to is replaced. A device or pipe gets the content at the end.

    Raises:
        InputError: the folder does not exist or cannot be written, or `path` is a folder.
    """
    path = Path(path)
    check_target(path)
    device = _is_device(path)
    target = path if device else path.resolve()
    folder = Path(tempfile.gettempdir()) if device else target.parent
    temporary = folder / f".{target.name}.{os.getpid()}.part"
    try:
        temporary.open("wb").close()
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=str(path)) from None
    try:
        yield temporary
        if device:
            with temporary.open("rb") as content, target.open("ab", buffering=0) as stream:
                shutil.copyfileobj(content, stream)
        else:
            os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=str(path)) from None
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replaced_files(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """A temporary folder inside ``folder``, whose files take the place of all of ``names`` there on success, in that order.

    A name that was not written this time is removed from ``folder``: what stays belongs together. Other files are left alone. On failure
    nothing has changed.

    Raises:
        InputError: ``folder`` cannot be made or written to.
    """
    folder = output_folder(Path(folder))
    staged = folder / f".{os.getpid()}.part"
    try:
        staged.mkdir()
        yield staged
        for name in names:
            if (staged / name).exists():
                os.replace(staged / name, folder / name)
            else:
                (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", where=str(folder)) from None
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def check_targets(targets: Mapping[str, str | Path | None], read: Mapping[str, str | Path | None]) -> None:
    """No output may be an input, nor another output, and all must be such as can be written: said before the work, not after it.

    Args:
        targets: files to write, by what they are; None or empty for one that is not asked for.
        read: files that are read, likewise; names that are no path of a file do no harm.

    Raises:
        InputError: two of them are one file, or one cannot be written.
    """
    taken = {Path(path).resolve(): f"the {what} that is read" for what, path in read.items() if path}
    for what, path in targets.items():
        if not path:
            continue
        target = Path(path).resolve()
        if target in taken:
            raise InputError(f"{what} is {taken[target]}", where=str(path), do="give another name")
        check_target(Path(path), what)
        if not _is_device(Path(path)):
            taken[target] = f"the same file as the {what}"
