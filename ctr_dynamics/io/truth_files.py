"""Truth files: where the tip of a simulated robot really was, as NumPy arrays (.npz)."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file
from ctr_dynamics.io.text_files import check_regular

Floats = NDArray[np.float64]
TRUTH = "give an .npz file, as `ctr-dynamics simulate --truth` writes it"


@dataclass(frozen=True)
class Truth:
    """The tip over time, in ``ctr_base``.

    Attributes:
        t: (k,) s, rising.
        position: (k, 3) m.
        quaternion: (k, 4) wxyz; None where the file has none.
        velocity: (k, 3) m/s of the tip point; None where the file has none.
        tracker_position: (k, 3) m, what an ideal tracker with the true registration would report; None where the file has none.
        start_ns: stamp of t = 0; None where the file does not say, then t = 0 is the first joint state.
    """

    t: Floats
    position: Floats
    quaternion: Floats | None = None
    velocity: Floats | None = None
    tracker_position: Floats | None = None
    start_ns: int | None = None


# Names of the arrays in a file: those of the attributes above, with their columns.
_ARRAYS = {
    "position": ("p", 3),
    "quaternion": ("q", 4),
    "velocity": ("v", 3),
    "tracker_position": ("p_trk", 3),
}


def write_truth(path: Path, truth: Truth) -> None:
    """Write a truth file: ``t``, ``p``, ``q``, ``v``, ``p_trk``, ``start_ns``.

    Raises:
        InputError: it cannot be written.
    """
    arrays: dict[str, Any] = {"t": truth.t}
    for attribute, (name, _) in _ARRAYS.items():
        value = getattr(truth, attribute)
        if value is not None:
            arrays[name] = value
    if truth.start_ns is not None:
        arrays["start_ns"] = np.array(truth.start_ns, dtype=np.int64)
    with atomic_file(path) as part, part.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def read_truth(path: Path) -> Truth:
    """Read a truth file; only ``t`` and ``p`` must be in it.

    Raises:
        InputError: not such a file, or its arrays have other shapes, are not finite, or their times do not rise.
    """
    where = str(path)
    check_regular(path, TRUTH)
    try:
        with np.load(path, allow_pickle=False) as data:
            t = np.asarray(data["t"], dtype=float)
            found = {
                key: np.asarray(data[name], dtype=float) for key, (name, _) in _ARRAYS.items() if name in data
            }
            start_ns = int(data["start_ns"]) if "start_ns" in data else None
    except KeyError as error:
        raise InputError(f"is no truth file ({error.args[0]})", do=TRUTH, where=where) from None
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile):
        raise InputError("is no truth file, or a damaged one", do=TRUTH, where=where) from None
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0.0).any():
        raise InputError("t holds no rising times", do="give at least two times in s", where=where)
    if "position" not in found:
        raise InputError("p is missing", do="give the tip's positions (k, 3) in m", where=where)
    for key, value in found.items():
        name, columns = _ARRAYS[key]
        if value.shape != (len(t), columns) or not np.isfinite(value).all():
            raise InputError(
                f"{name} has the shape {value.shape} or values that are not finite, expected {(len(t), columns)}",
                where=where,
            )
    return Truth(t, **found, start_ns=start_ns)
