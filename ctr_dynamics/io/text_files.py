"""Reading what a user names as a file: regular files of bounded size, UTF-8 text, every failure as one line."""

from __future__ import annotations

from pathlib import Path

from ctr_dynamics.errors import InputError

MAX_TEXT_BYTES = 8 * 2**20  # robot, parameter, scenario and layout files; the largest shipped one has 8 kB


def check_regular(path: Path, do: str = "give a file") -> None:
    """Allow regular files only: devices, pipes and sockets can block or never end. Links are followed.

    Raises:
        InputError: nothing there, a folder, or no regular file.
    """
    where = str(path)
    try:
        if path.is_dir():
            raise InputError("is a folder", do=do, where=where)
        if not path.exists():
            raise InputError("no such file", do="check the path", where=where)
        if not path.is_file():
            raise InputError("is a device, pipe or socket, not a regular file", do=do, where=where)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=where) from None


def read_bytes(path: Path, limit: int = MAX_TEXT_BYTES) -> bytes:
    """Contents of a regular file of at most ``limit`` bytes.

    Raises:
        InputError: no regular file, larger, or not readable.
    """
    check_regular(path)
    try:
        with path.open("rb") as stream:
            data = stream.read(limit + 1)
            size = path.stat().st_size
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", do="check path and rights", where=str(path)
        ) from None
    if len(data) > limit:
        raise InputError(f"has {size} bytes, limit {limit} bytes", do="give the right file", where=str(path))
    return data


def decode_text(data: bytes, where: str) -> str:
    """UTF-8 text, a byte order mark left out.

    Raises:
        InputError: not UTF-8.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"not UTF-8 at byte {error.start}", do="save as UTF-8 text", where=where) from None
