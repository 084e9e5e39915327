"""The bag that comes with the package, for the demo, the bench and the examples."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from ctr_dynamics.errors import InputError

NAME = "clean_release"


def shipped_bag() -> Path:
    """The bag: 6 s of `till2020_tissue`, whose tip weight is cut off at 1 s, as joint states, tracker poses and the known load.

    Raises:
        InputError: this installation lacks it.
    """
    return _file(f"{NAME}.mcap")


def shipped_truth() -> Path | None:
    """The simulator's own tip in that bag, an .npz file with `t` (k,) s and `p` (k, 3) m; None where it is not installed."""
    try:
        return _file(f"{NAME}.npz")
    except InputError:
        return None


def _file(name: str) -> Path:
    path = Path(str(resources.files("ctr_dynamics") / "data" / "bags" / name))
    if not path.is_file():
        raise InputError("the shipped bag is missing", do="give one with --bag", where=str(path))
    return path
