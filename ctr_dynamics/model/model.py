"""A robot in the form that the kernels use: parameter block, tube segments, scales of the shooting problem."""

from __future__ import annotations

import numpy as np

from ctr_dynamics.effects import make_setup
from ctr_dynamics.kernels.layout import Layout
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

LOAD_KINK = 0.02  # of the force and moment that bend the robot
PLAY_MOMENT = 0.01  # N m at which 70 % of a tube's play is taken up


class Model:
    """Numbers of one robot for the kernels.

    Attributes:
        n: number of tubes; tube 1 is the innermost.
        tubes, lane: tuples whose lengths tell the compiler the tube count and one lane; ``tubes`` holds floats for the extended kernels.
        extended: whether those are in use: when the robot file names an extension that changes the physics.
        jacobian_lanes: lanes of the Jacobian's sweep.
        layout: rows of the parameter block.
        plain_parameters: (NP,) block at the robot file's values without its extensions; actuators and tip wrench are 0.
        setup: what a prediction needs besides, extensions included. parameters: its block.
        scale: (5 + N,) N and N m, unit of each shooting residual; step: (5 + N,) perturbation of each unknown for Newton's
            method; tangent_step: a much smaller one, for tangents: strong friction between tubes bends the imbalance, and errors of a tangent grow
            from step to step.
        load_kink: (6,) N and N m: a change of a load's slope that adds more than this within a step is worth dividing the step.
        nodes: requested nodes from plate to tip.
    """

    def __init__(self, robot: Robot, nodes: int = 24, base_cells: int = 4, extended: bool = False) -> None:
        self.robot = robot
        self.n = n = robot.n_tubes
        self.lane = ()
        self.jacobian_lanes = lanes_for(6 + n)
        self.layout = Layout(n)
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
        bodies = [tube.end_body for tube in robot.tubes]
        inertia = np.array([body.inertia.value if body else (0.0, 0.0, 0.0) for body in bodies])
        self.plain_parameters = self.layout.pack(
            bending_stiffness=[tube.bending_stiffness for tube in robot.tubes],
            torsional_stiffness=[tube.torsion_stiffness for tube in robot.tubes],
            mass_per_length=[tube.density.value * tube.area for tube in robot.tubes],
            inertia_per_length=[tube.density.value * tube.second_moment for tube in robot.tubes],
            bending_damping=[tube.bending_damping.value for tube in robot.tubes],
            torsion_damping=[tube.torsion_damping.value for tube in robot.tubes],
            precurvature=1.0,
            body_mass=[body.mass.value if body else 0.0 for body in bodies],
            body_inertia_x=inertia[:, 0],
            body_inertia_y=inertia[:, 1],
            body_inertia_z=inertia[:, 2],
            gravity=robot.gravity.value,
            tube_coulomb=robot.friction.tubes.coulomb.value,
            tube_viscous=robot.friction.tubes.viscous.value,
            epsilon=robot.friction.epsilon.value,
            base_coulomb=robot.friction.base.coulomb.value,
            base_viscous=robot.friction.base.viscous.value,
            play_moment=PLAY_MOMENT,
            play_share=1.0,
        )
        self.setup = make_setup(self)
        self.parameters = self.setup.block
        self.extended = extended or self.setup.extended
        self.tubes: tuple[float, ...] = (0.0,) * n if self.extended else (0,) * n
        reach = float(robot.lengths[0] + robot.rest.beta.value[0])
        stiffness = robot.tubes[0].bending_stiffness
        force, moment = stiffness / reach**2, stiffness / reach
        self.scale = np.array([force] * 3 + [moment] * (2 + n))
        self.load_kink = LOAD_KINK * np.array([force] * 3 + [moment] * 3)
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
