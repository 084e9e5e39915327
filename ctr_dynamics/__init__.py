"""Dynamics, estimation and ROS 2 node for concentric tube robots."""

import os

# The filter's matrices are small: a second BLAS thread gains nothing and, on a busy machine, waits for its time slice for up to 100 ms.
for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

__version__ = "0.1.0"
