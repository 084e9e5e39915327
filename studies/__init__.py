"""Long studies for developers, on top of the package and its tests: `python -m studies.NAME --help`, in the source tree.

What a user measures on a machine of his own is `ctr-dynamics bench`.
"""

import sys
from pathlib import Path

TRUTH = Path(__file__).resolve().parents[1] / "test" / "diagnosis"


def add_truth_path() -> None:
    """Make the simulator of the diagnosis tests importable as `truth`."""
    if str(TRUTH) not in sys.path:
        sys.path.insert(0, str(TRUTH))
