"""From a path to the MCAP files it means: a file, a rosbag2 folder, or a folder that holds one file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from ctr_dynamics.errors import InputError

METADATA = "metadata.yaml"
_MAX_METADATA_BYTES = 16 * 2**20


@dataclass
class Located:
    """The files of one bag, in the order of recording, and what was noticed on the way."""

    path: Path
    files: list[Path]
    notes: list[str] = field(default_factory=list)


def locate(path: str | Path) -> Located:
    """Files of the bag at `path`: an ``.mcap`` file, a rosbag2 folder (also split), or a folder that holds
    exactly one ``.mcap``.

    Raises:
        InputError: nothing there, no or several ``.mcap`` without a ``metadata.yaml``, another storage or a
            compression of whole files or messages.
    """
    path = Path(path)
    try:
        if path.name == METADATA and path.is_file():
            path = path.parent
        if path.is_dir():
            return _locate_in_folder(path)
        if not path.exists():
            raise InputError("no such bag", where=str(path), do="give an .mcap file or a bag folder")
        if not path.is_file():
            raise InputError("not a regular file", where=str(path), do="give an .mcap file or a bag folder")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None
    return Located(path, [path])


def _locate_in_folder(folder: Path) -> Located:
    present = sorted(item for item in folder.glob("*.mcap") if item.is_file())
    if (folder / METADATA).is_file():
        notes: list[str] = []
        information = _read_metadata(folder / METADATA, notes)
        if information is not None:
            return _from_metadata(folder, information, present)
        if len(present) == 1:
            return Located(folder, present, notes)
    if not present:
        other = next(
            (item.name for pattern in ("*.db3", "*.mcap.zstd", "*.bag") for item in folder.glob(pattern)), ""
        )
        if other:
            raise InputError(
                f"holds no .mcap file, but {other}",
                where=str(folder),
                do="convert it with `ros2 bag convert`",
            )
        raise InputError("holds no .mcap file", where=str(folder), do="give an .mcap file or a bag folder")
    if len(present) > 1:
        names = ", ".join(item.name for item in present[:4]) + (", ..." if len(present) > 4 else "")
        raise InputError(
            f"holds {len(present)} .mcap files and no usable {METADATA} ({names}), 1 is expected",
            where=str(folder),
            do="give one of the files",
        )
    return Located(folder, present)


def _read_metadata(path: Path, notes: list[str]) -> dict[str, Any] | None:
    """The rosbag2 information, or None with a note when the file is unusable."""
    try:
        if path.stat().st_size > _MAX_METADATA_BYTES:
            raise ValueError(f"larger than {_MAX_METADATA_BYTES} bytes")
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        information = content["rosbag2_bagfile_information"]
        if not isinstance(information, dict):
            raise ValueError("not a rosbag2 description")
        return information
    except (OSError, ValueError, KeyError, TypeError, RecursionError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())[:120]
        notes.append(
            f"{path.name} is not usable ({type(error).__name__}: {reason}); the .mcap file is read without it"
        )
        return None


def _from_metadata(folder: Path, information: dict[str, Any], present: list[Path]) -> Located:
    storage = str(information.get("storage_identifier") or "mcap")
    if storage != "mcap":
        raise InputError(
            f"storage {storage!r}, only 'mcap' is read",
            where=str(folder),
            do="convert it with `ros2 bag convert`",
        )
    mode = str(information.get("compression_mode") or "").lower()
    if mode not in ("", "none", "storage"):
        raise InputError(
            f"compression mode {mode!r} of rosbag2, only compression inside the .mcap file is read",
            where=str(folder),
            do="convert it with `ros2 bag convert`",
        )
    listed = information.get("relative_file_paths")
    names = [str(name) for name in listed] if isinstance(listed, list) else []
    files = [folder / Path(name).name for name in names]
    found = [item for item in files if item.is_file()]
    notes = [f"{item.name} is named in {METADATA} but is not there" for item in files if not item.is_file()]
    if not found and len(present) == 1:
        return Located(folder, present, notes)
    if not found:
        missing = ", ".join(item.name for item in files[:4]) or "none"
        raise InputError(
            f"none of the files named in {METADATA} is there ({missing})",
            where=str(folder),
            do="copy the .mcap files next to it",
        )
    return Located(folder, found, notes)
