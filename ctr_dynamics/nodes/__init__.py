"""ROS 2 nodes: the estimator and a driver that plays a bag; the only place, with `messages`, that knows ROS.

The small matrices of the estimator gain nothing from threaded linear algebra, and spinning worker threads
take the second core from the middleware: one thread each, unless the environment says otherwise. This has to
happen before NumPy is first imported, hence here.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
