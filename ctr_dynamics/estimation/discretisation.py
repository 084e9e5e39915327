"""Nodes and steps for the accuracy that is asked, from the vibration modes at rest (docs/model.md, "Accuracy").

The error of a mesh is in the modes' frequencies, and falls with the fourth power of the nodes. So do two meshes tell how many nodes a robot
needs. The error of the steps is in the modes' phase and amplitude; a mode that is too fast for the steps is unresolved.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.timeline import DT
from ctr_dynamics.estimation.vibration_modes import ModalBasis, modal_basis
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.segments import growth
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import Collocation, collocation
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
MODES = 8  # of the basis; its Krylov space holds as many
COARSE, FINE = 12, 24  # nodes of the meshes whose frequencies are compared
MOST = 100  # nodes that are chosen: more cost several times the real time on any machine
DURATION = 4.0  # s that a vibration is followed without damping
DEFLECTION = 1.0 / 3.0  # of the exposed length: what a force of E I / L^2 on its tip does to a uniform tube
GROWTH_PER_CELL = 1.2  # beyond 1.3 a mesh is unstable in time
AMPLITUDE, PHASE, PERIODS = 0.02, 0.1, 50  # within which a resolved mode stays, the phase in rad


RESOLVED_HZ = 103.0  # highest frequency that steps of 3 ms resolve so; a test holds it to `resolved`


@dataclass(frozen=True)
class Mode:
    """A vibration mode at rest: frequency in Hz, damping ratio, amplitude m of the tip after the reference load, and whether the steps resolve it."""

    frequency_hz: float
    damping: float
    amplitude_m: float
    resolved: bool


class VibrationErrors(NamedTuple):
    """How the robot vibrates at rest, and how the model goes astray from it, mode by mode (m).

    Attributes:
        exponent: (m,) complex, 1/s. twist: (m, 6) complex, of the tip by the modal coordinate
            (:class:`~ctr_dynamics.estimation.vibration_modes.ModalBasis`).
        by_load: (m, 6) complex, modal coordinate of the equilibrium by force and torque; by_rotation: (m, N) complex, by the tubes' rotations.
        phase_rate: (m,) rad/s, errors of nodes and steps. tolerance: relative deviation of a frequency by the robot file's tolerances.
        resolved: (m,) whether the steps resolve it. reach: (m,) of the tip's displacements, where all have the same energy.
    """

    exponent: NDArray[np.complex128]
    twist: NDArray[np.complex128]
    by_load: NDArray[np.complex128]
    by_rotation: NDArray[np.complex128]
    phase_rate: Floats
    tolerance: float
    resolved: NDArray[np.bool_]
    reach: Floats

    def deflection(self, difference: Floats) -> float:
        """m, by which a load's ``difference`` (6,) N, N m moves the resting tip."""
        moved = (self.twist[:, :3] / self.exponent[:, None]).T @ (self.by_load @ difference)
        return float(np.linalg.norm(2.0 * moved.real))

    @classmethod
    def none(cls) -> VibrationErrors:
        """Of a robot whose modes are not known."""
        no_rows = np.zeros((0, 6), complex)
        return cls(
            np.zeros(0, complex), no_rows, no_rows, no_rows, np.zeros(0), 0.0, np.zeros(0, bool), np.zeros(0)
        )


@dataclass(frozen=True)
class Discretisation:
    """Nodes of the model, and what errors to expect of the tip.

    Attributes:
        nodes: chosen.
        space_error_m, time_error_m: rms over 4 s after a load is cut that deflects the tip by a third of the exposed length; None where the modes
        are not known.
        modes: the slowest at rest. vibration: their shapes at the tip and errors.
    """

    nodes: int
    space_error_m: float | None
    time_error_m: float | None
    modes: tuple[Mode, ...]
    vibration: VibrationErrors

    def shortfall(self, accuracy_m: float) -> str:
        """What of the accuracy that is asked cannot be had in steps of 3 ms; empty where nothing is missing."""
        if not self.modes:
            return "no vibration modes are found at rest; the errors of nodes and steps are not known"
        lost = math.hypot(*(mode.amplitude_m for mode in self.modes if not mode.resolved), 0.0)
        found = []
        if lost > accuracy_m:
            found.append(
                f"modes above {RESOLVED_HZ:.0f} Hz are too fast for the steps: of the {1e3 * lost:.2f} mm that they vibrate after an abrupt load the "
                "model follows the mean alone"
            )
        for name, error in (("nodes", self.space_error_m), ("steps", self.time_error_m)):
            if error is not None and error > accuracy_m:
                found.append(f"the {name} leave an error of {1e3 * error:.3f} mm")
        return "; ".join(found)

    def numerics(self) -> dict[str, Any]:
        """For a summary."""
        unresolved = [mode.frequency_hz for mode in self.modes if not mode.resolved]
        return {
            "nodes": self.nodes,
            "space_error_m": self.space_error_m,
            "time_error_m": self.time_error_m,
            "unresolved_modes_hz": unresolved,
            "modes": [asdict(mode) for mode in self.modes],
        }


def amplification(scheme: Collocation, z: NDArray[np.complexfloating]) -> NDArray[np.complex128]:
    """By what a step multiplies the mode exp(z t / dt), z (k,)."""
    C = scheme.coefficients.C * scheme.dt
    inside = np.linalg.solve(
        C[None] - z[:, None, None] * np.eye(len(C)), np.tile(C.sum(1), (len(z), 1))[..., None]
    )
    found: NDArray[np.complex128] = inside[:, -1, 0]
    return found


def resolved(scheme: Collocation, frequency_hz: Floats) -> NDArray[np.bool_]:
    """Whether 50 undamped periods of each frequency (k,) keep 2 % of their amplitude and 0.1 rad of their phase."""
    z = 2j * np.pi * frequency_hz * scheme.dt
    ratio = amplification(scheme, z) * np.exp(-z)
    steps = PERIODS / (frequency_hz * scheme.dt)
    decay, phase = np.abs(ratio) ** steps, np.abs(np.angle(ratio)) * steps
    return (np.abs(decay - 1.0) <= AMPLITUDE) & (phase <= PHASE) & (frequency_hz * scheme.dt < 0.5)


def discretise(robot: Robot, least: int, accuracy_m: float) -> Discretisation:
    """Nodes for which the error of the mesh stays below ``accuracy_m``, at ``least`` so many."""
    scheme = collocation(DT)
    coarse, fine = _modes_at(robot, COARSE), _modes_at(robot, FINE)
    model = Model(robot, nodes=COARSE)
    beta = np.array(robot.rest.beta.value)
    try:
        _, mesh = model.mesh(beta)
        steepest = max(
            growth(model, mesh, beta, rate).sum() for rate in scheme.parted(DT / 2).coefficients.rates
        )
        least = max(least, math.ceil(steepest / GROWTH_PER_CELL) + 1)
    except InputError:
        return Discretisation(least, None, None, (), VibrationErrors.none())
    if coarse is None or fine is None:
        return Discretisation(least, None, None, (), VibrationErrors.none())
    count = min(len(coarse.frequency_hz), len(fine.frequency_hz))
    frequency, damping = fine.frequency_hz[:count], np.maximum(fine.damping[:count], 0.0)
    amplitude = _amplitudes(fine, robot)[:count]
    followed = np.minimum(DURATION, 1.0 / np.maximum(damping * 2 * np.pi * frequency, 1e-12))
    kept = resolved(scheme, frequency)
    # of 4th order: the coarse mesh errs by 16/15 of what the two differ
    shift = np.abs(coarse.frequency_hz[:count] / frequency - 1.0) / (1.0 - (COARSE / FINE) ** 4)
    at_coarse = _tip_error(amplitude, kept * 2 * np.pi * frequency * followed * shift)
    wanted = COARSE * (at_coarse / accuracy_m) ** 0.25
    nodes = max(least, min(MOST, math.ceil(wanted)))
    z = 2j * np.pi * frequency * DT
    by_steps = np.abs(amplification(scheme, z) - np.exp(z)) / DT  # 1/s
    time_error = _tip_error(amplitude, kept * np.minimum(by_steps * followed, 2.0))
    modes = tuple(
        Mode(float(f), float(d), float(a), bool(k))
        for f, d, a, k in zip(frequency, damping, np.linalg.norm(amplitude, axis=1), kept, strict=True)
    )
    m, n = len(fine.frequency_hz), robot.n_tubes
    by_inputs = (fine.by_inputs[:m] + 1j * fine.by_inputs[m:])[:count]
    vibration = VibrationErrors(
        np.minimum(fine.exponent[:count].real, 0.0) + 1j * fine.exponent[:count].imag,
        fine.twist[:count],
        by_inputs[:, 2 * n :],
        by_inputs[:, :n],
        np.hypot(2 * np.pi * frequency * shift * (COARSE / nodes) ** 4, by_steps),
        frequency_tolerance(robot),
        kept,
        fine.reach[:count],
    )
    return Discretisation(nodes, at_coarse * (COARSE / nodes) ** 4, time_error, modes, vibration)


def frequency_tolerance(robot: Robot) -> float:
    """Relative deviation of a mode's frequency, at most: half of those of stiffness and mass, in the mean square."""
    stiffness = mass = 0.0
    for tube in robot.tubes:
        stiffness = max(stiffness, tube.youngs_modulus.tolerance / tube.youngs_modulus.value)
        mass = max(mass, tube.density.tolerance / tube.density.value)
        if tube.end_body is not None and tube.end_body.mass.value > 0.0:
            mass = max(mass, tube.end_body.mass.tolerance / tube.end_body.mass.value)
    return 0.5 * math.hypot(stiffness, mass)


def _modes_at(robot: Robot, nodes: int) -> ModalBasis | None:
    """Modes at rest on a mesh of ``nodes``; None where there is no equilibrium, or no mode."""
    model = Model(robot, nodes=nodes)
    beta, alpha = np.array(robot.rest.beta.value), np.array(robot.rest.alpha.value)
    par = model.parameters.copy()
    par[model.layout["alpha"]], par[model.layout["beta"]] = alpha, beta
    try:
        rest = Statics(model).solve(beta, alpha)
    except InputError:
        return None
    return modal_basis(model, rest, par, beta, MODES) if rest.converged else None


def _amplitudes(basis: ModalBasis, robot: Robot) -> Floats:
    """(m, 3) m, how much of every mode the reference force on the tip excites along each axis of ``ctr_base``."""
    m, n = len(basis.frequency_hz), robot.n_tubes
    by_force = 2.0 * np.abs(basis.by_inputs[:m, 2 * n : 2 * n + 3])
    return DEFLECTION * robot.exposed_length * by_force / max(float(by_force.sum(axis=0).max()), 1e-300)


def _tip_error(amplitude: Floats, phase: Floats) -> float:
    """m, rms of the tip's error along the worst direction of the load, from the modes' ``amplitude`` (m, 3) and final errors of ``phase`` (m,) rad.

    Modes of different frequencies add in the mean square. An error that grows with the time has an rms of its last value by sqrt 3, and so has a sine
    by sqrt 2.
    """
    return float(np.linalg.norm(amplitude * phase[:, None], axis=0).max() / math.sqrt(6))
