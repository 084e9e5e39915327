"""Dynamics, estimation and ROS 2 node for concentric tube robots."""

import hashlib
import os
import sys
from pathlib import Path

# The filter's matrices are small: a second BLAS thread gains nothing and, on a busy machine, waits for its time slice for up to 100 ms.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def _kernel_cache() -> str:
    """Folder for compiled kernels, one for each state of the sources.

    Numba by itself looks at the file of a kernel only, not at those of the kernels that it calls.
    """
    here = Path(__file__).parent
    stamps = sorted(
        (p.name, p.stat().st_mtime_ns)
        for folder in ("model", "estimation", "snap")
        for p in (here / folder).glob("*.py")
    )
    digest = hashlib.sha256(repr(stamps).encode()).hexdigest()[:16]
    made = Path(sys.prefix) / "numba-cache"  # what `make` has compiled
    base = Path(
        os.environ.get("NUMBA_CACHE_DIR")
        or (made if os.access(made, os.W_OK) else None)
        or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "ctr_dynamics"
    )
    return str(base if base.name == digest else base / digest)


os.environ["NUMBA_CACHE_DIR"] = _kernel_cache()

__version__ = "0.1.0"
