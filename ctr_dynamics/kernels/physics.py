"""The equations at one point, of the physics that a robot needs.

Each of these functions is the one of that name in :mod:`ctr_dynamics.kernels.plain_physics` or in
:mod:`ctr_dynamics.kernels.extended_physics`. The compiler chooses by the :class:`~ctr_dynamics.kernels.kinds.RobotKind`, so that the plain physics
pays nothing for the other.
"""

from ctr_dynamics.kernels import extended_physics as extended
from ctr_dynamics.kernels import plain_physics as plain
from ctr_dynamics.kernels.kinds import by_physics

curvature = by_physics(plain.curvature, extended.curvature)
derivative = by_physics(plain.derivative, extended.derivative)
bending_moments = by_physics(plain.bending_moments, extended.bending_moments)
start_motion = by_physics(plain.start_motion, extended.start_motion)
start_section = by_physics(plain.start_section, extended.start_section)
move_grid = by_physics(plain.move_grid, extended.move_grid)
coulomb = by_physics(plain.coulomb, extended.coulomb)
drive = by_physics(plain.drive, extended.drive)
base_stretch = by_physics(plain.base_stretch, extended.base_stretch)
tilt = by_physics(plain.tilt, extended.tilt)
tip_forces = by_physics(plain.tip_forces, extended.tip_forces)
