"""A robot in the form that the kernels use: parameter block, tube segments, scales of the shooting problem."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_dynamics.effects import make_plant
from ctr_dynamics.kernels.kinds import Physics, RobotKind, cut_size, unknown_lanes
from ctr_dynamics.kernels.layout import input_rows, unknown_rows
from ctr_dynamics.kernels.shooting import sweep_buffers
from ctr_dynamics.kernels.structures import ShootingOptions, ShootingSolver, SweepBuffers
from ctr_dynamics.model.mesh import (
    Key,
    Mesh,
    Segment,
    Tubes,
    build_mesh,
    fits,
    node_count,
    point_count,
    section_key,
)
from ctr_dynamics.robot import Robot

LOAD_SLOPE_LIMIT = 0.02  # of the force and moment that bend the robot
SHOOTING_ITERATIONS = 40


class Model:
    """A robot in the form that the solvers use: build one and give it to :class:`Statics` and :class:`Simulator`.

    Args:
        robot: from a robot file.
        nodes: arc-length nodes from the base plate to the tip.
        base_cells: cells of each tube behind the plate.
        extended: use the kernels of the extended physics even where the robot file asks for none.

    Example:
        >>> from ctr_dynamics import Model, load_robot
        >>> model = Model(load_robot("till2020_tissue"), nodes=24)
        >>> model.n, model.scale.shape  # tubes, and the units of the 5 + N shooting residuals
        (2, (7,))

    Attributes:
        n: number of tubes; tube 1 is the innermost.
        extended: whether the extended physics is in use: when the robot file names an extension that needs it.
        kind: number of tubes and physics, for the compiler.
        layout: rows of the parameter block.
        plant: the robot file with its extensions. parameters: (NP,) its block; actuators and tip wrench are 0.
        scale: (5 + N,) N and N m, unit of each shooting residual.
        perturbation: (5 + N,) finite-difference perturbation of each unknown for Newton's method.
        tangent_perturbation: a much smaller one, for tangents: strong friction between tubes makes the residual nonlinear, and errors of a tangent
            grow from step to step.
        load_slope_limit: (6,) N and N m: a change of a load's slope that adds more than this within a step is worth dividing the step.
        nodes: requested nodes from plate to tip.
        cuts: where :mod:`ctr_dynamics.model.segments` has cut each set of sections, so that all runs of a model share that.
    """

    def __init__(self, robot: Robot, nodes: int = 24, base_cells: int = 4, extended: bool = False) -> None:
        self.robot = robot
        self.n = n = robot.n_tubes
        self.plant = make_plant(robot)
        self.layout, self.parameters = self.plant.layout, self.plant.block
        self.nodes = nodes
        self.base_cells = base_cells
        self.segments: Tubes = tuple(
            tuple(
                Segment(float(start), float(end), np.ascontiguousarray(segment.coefficients, dtype=float))
                for segment, start, end in zip(
                    tube.precurvature, tube.breakpoints[:-1], tube.breakpoints[1:], strict=True
                )
            )
            for tube in robot.tubes
        )
        self.extended = extended or self.plant.extended
        self.kind = RobotKind(n, Physics.EXTENDED if self.extended else Physics.PLAIN)
        reach = robot.exposed_length
        stiffness = robot.tubes[0].bending_stiffness
        force, moment = stiffness / reach**2, stiffness / reach
        self.scale = np.array([force] * 3 + [moment] * (2 + n))
        self.load_slope_limit = LOAD_SLOPE_LIMIT * np.array([force] * 3 + [moment] * 3)
        self.perturbation = np.array([moment] * n + [force] * 3 + [moment] * 2) * 1e-6
        self.tangent_perturbation = 5e-5 * self.perturbation
        self._meshes: dict[Key, Mesh] = {}
        self.cuts: dict[tuple[Key, complex], Any] = {}
        # precurvature that varies within a tube's segments, or twists it behind the plate, moves over the cells with the tube
        self.moving_precurvature = any(
            segment.coefficients.shape[1] > 1 or segment.coefficients[2, 0] != segments[0].coefficients[2, 0]
            for segments in self.segments
            for segment in segments
        )

    @property
    def unknown_count(self) -> int:
        """Unknowns of the shooting problem, 5 + N."""
        return unknown_rows(self.n).size

    @property
    def input_count(self) -> int:
        """Inputs of a stage: alpha, its rate, beta of every tube, force and torque on the tip, and beta rates in the extended model."""
        rows = input_rows(self.n)
        return rows.size if self.extended else rows.beta_rate

    def mesh(self, beta: np.ndarray, key: Key | None = None) -> tuple[Key, Mesh]:
        """Key and mesh of the sections at the translations ``beta`` (N,) m; with ``key`` the sections are kept while they still suit.

        Raises:
            InputError: a tube would end behind the plate or beyond an inner one.
        """
        if key is None or not fits(key, self.segments, beta, self.nodes):
            key = section_key(self.segments, beta, self.nodes)
        if self.moving_precurvature:
            return key, build_mesh(self.segments, beta, key, self.base_cells)
        if key not in self._meshes:
            self._meshes[key] = build_mesh(self.segments, beta, key, self.base_cells)
        return key, self._meshes[key]

    def sweep_buffers(self, mesh: Mesh, lanes: int, cuts: int = 0) -> SweepBuffers:
        """Zeroed buffers of a sweep with ``lanes`` lanes, and unknown states at so many ``cuts``."""
        more = cuts * cut_size(self.kind)
        return sweep_buffers(self.n, mesh, point_count(mesh), node_count(mesh), lanes, more)

    def shooting_solver(
        self,
        mesh: Mesh,
        tolerance: float,
        parameters: np.ndarray | None = None,
        jacobian: SweepBuffers | None = None,
        limit: int = SHOOTING_ITERATIONS,
    ) -> ShootingSolver:
        """Buffers and options of a shooting problem on ``mesh``.

        Args:
            tolerance: largest scaled residual. limit: most iterations.
            parameters: (NP,) array to read instead of one of its own.
            jacobian: buffers of at least the Jacobian's lanes, of which it takes the first part.
        """
        single, lanes = self.sweep_buffers(mesh, 1), unknown_lanes(self.kind).count
        if jacobian is None:
            wide = self.sweep_buffers(mesh, lanes)
        else:
            wide = SweepBuffers(
                *(shared[: len(own) * lanes] for shared, own in zip(jacobian, single, strict=True))
            )
        if parameters is not None:
            single = single._replace(parameters=parameters)
        options = ShootingOptions(self.scale, self.perturbation, tolerance, limit)
        return ShootingSolver(single, wide, options)
