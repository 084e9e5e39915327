"""A robot in the form that the kernels use: parameter block, tube segments, scales of the shooting problem."""

from __future__ import annotations

import numpy as np

from ctr_dynamics.effects import make_plant
from ctr_dynamics.kernels.shooting import buffers, lanes_for
from ctr_dynamics.kernels.workspace import workspace_rows
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
        tubes, lane: tuples whose lengths tell the compiler the tube count and one lane; ``tubes`` holds floats for the extended kernels.
        extended: whether those are in use: when the robot file names an extension that changes the physics.
        jacobian_lanes: lanes of the Jacobian's sweep.
        layout: rows of the parameter block.
        plant: the robot file with its extensions. parameters: (NP,) its block; actuators and tip wrench are 0.
        scale: (5 + N,) N and N m, unit of each shooting residual; step: (5 + N,) perturbation of each unknown for Newton's
            method; tangent_step: a much smaller one, for tangents: strong friction between tubes bends the residual, and errors of a tangent grow
            from step to step.
        load_slope_limit: (6,) N and N m: a change of a load's slope that adds more than this within a step is worth dividing the step.
        nodes: requested nodes from plate to tip.
    """

    def __init__(self, robot: Robot, nodes: int = 24, base_cells: int = 4, extended: bool = False) -> None:
        self.robot = robot
        self.n = n = robot.n_tubes
        self.lane = ()
        self.jacobian_lanes = lanes_for(6 + n)
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
        self.tubes: tuple[float, ...] = (0.0,) * n if self.extended else (0,) * n
        reach = float(robot.lengths[0] + robot.rest.beta.value[0])
        stiffness = robot.tubes[0].bending_stiffness
        force, moment = stiffness / reach**2, stiffness / reach
        self.scale = np.array([force] * 3 + [moment] * (2 + n))
        self.load_slope_limit = LOAD_SLOPE_LIMIT * np.array([force] * 3 + [moment] * 3)
        self.step = np.array([moment] * n + [force] * 3 + [moment] * 2) * 1e-6
        self.tangent_step = 5e-5 * self.step
        self._meshes: dict[Key, Mesh] = {}
        # precurvature that varies within a tube's segments, or twists it behind the plate, moves over the cells with the tube
        self.moving_precurvature = any(
            segment.coefficients.shape[1] > 1 or segment.coefficients[2, 0] != segments[0].coefficients[2, 0]
            for segments in self.segments
            for segment in segments
        )

    @property
    def input_count(self) -> int:
        """Inputs of a stage: alpha, its rate, beta of every tube, force and torque on the tip, and beta rates in the extended model."""
        return (4 if self.extended else 3) * self.n + 6

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

    def buffers(self, mesh: Mesh, lanes: int) -> tuple[np.ndarray, ...]:
        """Buffers of a sweep: (W, par, seclen, x, hist, histb, out, outb, nodes, res), flat, ``lanes`` numbers a row."""
        return buffers(self.n, mesh, point_count(mesh), node_count(mesh), lanes, workspace_rows(self.n))
