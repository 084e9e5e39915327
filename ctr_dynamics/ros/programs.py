"""The executables of `ros2 run ctr_dynamics`: each prepares its process, then imports its node."""

from __future__ import annotations

from ctr_dynamics.one_blas_thread import one_blas_thread


def estimator() -> int:
    """Run the estimator node; returns the exit code."""
    one_blas_thread()
    from ctr_dynamics.ros.estimator_node import main

    return main()


def managed_estimator() -> int:
    """Run the estimator as a managed node; returns the exit code."""
    one_blas_thread()
    from ctr_dynamics.ros.managed_estimator_node import main

    return main()


def driver() -> int:
    """Run the driver node, which plays a bag; returns the exit code."""
    one_blas_thread()
    from ctr_dynamics.ros.driver_node import main

    return main()


def tube_markers() -> int:
    """Run the node that draws the tubes; returns the exit code."""
    one_blas_thread()
    from ctr_dynamics.ros.view_node import main

    return main()
