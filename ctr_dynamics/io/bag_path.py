"""From a path to the files it means: one file, a rosbag2 folder, or a folder that holds one bag."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.text_files import decode_text, read_bytes
from ctr_dynamics.io.yaml_files import read_yaml

METADATA = "metadata.yaml"
_MAX_METADATA_BYTES = 16 * 2**20
_SUFFIXES = (".mcap", ".db3", ".bag")
_PACKED = ("", ".zstd", ".zst")
_GIVE = "give a bag: an .mcap, .db3 or .bag file, or a folder with one"
# A split bag's parts: NAME_0.mcap, NAME_1.mcap, ... (ROS 1: NAME_0.bag, or NAME_DATE_0.bag)
_PART = re.compile(r"(?P<stem>.*?)(?:_\d{4}(?:-\d\d){5})?_(?P<number>\d+)")


@dataclass
class Located:
    """The files of one bag, in the order of recording, and what was noticed on the way."""

    path: Path
    files: list[Path]
    notes: list[str] = field(default_factory=list)


def locate(path: str | Path) -> Located:
    """Files of the bag at `path`: a file (``.mcap``, ``.db3``, ``.bag``, also compressed with zstd), a rosbag2 folder (also split), or a folder
    that holds one bag, whole or in numbered parts, without a ``metadata.yaml``.

    Raises:
        InputError: nothing there, or several bags.
    """
    path = Path(path)
    try:
        if path.name == METADATA and path.is_file():
            path = path.parent
        if path.is_dir():
            return _locate_in_folder(path)
        if not path.exists():
            raise InputError("no such bag", where=str(path), do=_GIVE)
        if not path.is_file():
            raise InputError("not a regular file", where=str(path), do=_GIVE)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None
    return Located(path, [path])


def _bag_suffix(path: Path) -> str:
    """The format that a file's name claims; empty for other files."""
    for suffix in _SUFFIXES:
        if any(path.name.endswith(suffix + packed) for packed in _PACKED):
            return suffix
    return ""


def _locate_in_folder(folder: Path) -> Located:
    present = sorted(item for item in folder.iterdir() if item.is_file() and _bag_suffix(item))
    present = [item for item in present if not _packed_twin(item, present)]
    converted = [item for item in present if _bag_suffix(item) == ".mcap"]
    notes: list[str] = []
    if (folder / METADATA).is_file():
        information = _read_metadata(folder / METADATA, notes)
        if information is not None:
            return _from_metadata(folder, information, present)
    if not present:
        raise InputError("holds no .mcap, .db3 or .bag file", where=str(folder), do=_GIVE)
    parts = _parts(
        converted or present
    )  # beside an .mcap, a bag of another format is what it was converted from
    if not parts:
        names = ", ".join(item.name for item in present[:4]) + (", ..." if len(present) > 4 else "")
        raise InputError(
            f"holds {len(present)} bags ({names}) and no usable {METADATA} that says they are parts of one",
            where=str(folder),
            do="give one of the files",
        )
    if len(parts) > 1:
        notes.append(f"{METADATA} is not there: {len(parts)} numbered files are read as parts of one bag")
    return Located(folder, parts, notes)


def _packed_twin(item: Path, present: list[Path]) -> bool:
    """Whether a compressed file lies beside its unpacked content."""
    plain = item.name.removesuffix(".zstd").removesuffix(".zst")
    return plain != item.name and any(other.name == plain for other in present)


def _parts(present: list[Path]) -> list[Path]:
    """The files in the order of their numbers where they are parts of one bag; empty where they are several bags."""
    if len(present) == 1:
        return present
    numbered: list[tuple[int, Path]] = []
    stems: set[tuple[str, str]] = set()
    for item in present:
        suffix = _bag_suffix(item)
        match = _PART.fullmatch(item.name[: item.name.rindex(suffix)])
        if match is None:
            return []
        stems.add((match["stem"], suffix))
        numbered.append((int(match["number"]), item))
    if len(stems) > 1 or len({number for number, _ in numbered}) < len(numbered):
        return []
    return [item for _, item in sorted(numbered)]


def _read_metadata(path: Path, notes: list[str]) -> dict[str, Any] | None:
    """The rosbag2 information, or None with a note when the file is unusable."""
    try:
        content = read_yaml(decode_text(read_bytes(path, _MAX_METADATA_BYTES), path.name), path.name)
        information = content["rosbag2_bagfile_information"]
        if not isinstance(information, dict):
            raise ValueError("not a rosbag2 description")
        return information
    except (ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())[:120]
        notes.append(
            f"{path.name} is not usable ({type(error).__name__}: {reason}); the files beside it are read without it"
        )
        return None


def _from_metadata(folder: Path, information: dict[str, Any], present: list[Path]) -> Located:
    listed = information.get("relative_file_paths")
    names = [str(name) for name in listed] if isinstance(listed, list) else []
    files: list[Path] = []
    notes: list[str] = []
    for name in (Path(name).name for name in names):
        found = next(
            (item for item in present if item.name in (name, f"{name}.zstd", f"{name}.zst")),
            next((item for item in present if item.name == name.removesuffix(".zstd")), None),
        )
        if found is None:
            notes.append(f"{name} is named in {METADATA} but is not there")
        elif found not in files:
            files.append(found)
    if not files and (parts := _parts(present)):
        return Located(folder, parts, notes)
    if not files:
        missing = ", ".join(Path(name).name for name in names[:4]) or "none"
        raise InputError(
            f"none of the files named in {METADATA} is there ({missing})",
            where=str(folder),
            do="copy the files of the bag next to it",
        )
    return Located(folder, files, notes)
