"""One BLAS thread for the package's own processes: its commands and nodes."""

import os


def one_blas_thread() -> None:
    """Ask for one thread, unless the environment says otherwise. It counts only before NumPy is imported for the first time.

    The filter's matrices are small. A second thread gains nothing and, on a busy machine, waits for its time slice for up to 100 ms. A program
    that only uses the package keeps its own setting.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
