"""Imported first by the package's own processes (commands and nodes), before numpy: one BLAS thread.

The filter's matrices are small: a second thread gains nothing and, on a busy machine, waits for its time slice for up to 100 ms. A program that
only uses the package keeps its own setting.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
