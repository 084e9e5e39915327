"""What drives a run at the stages of a step: interpolated joints and load, with the run's corrections."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.kernels.stage_inputs import corrected_rows, stage_rows
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs
from ctr_dynamics.sensing.interpolation import ThreePoints

Floats = NDArray[np.float64]
# Time constant with which actuators that differ from what is known of them join it: a few steps, so that their rates stay those of a motion.
REJOIN_S = 0.01


class InterpolatedInputs:
    """Actuators and known load at the stages of a step, interpolated between their stamps. Those of one step are remembered, as both runs ask.

    Args:
        model: the robot.
        inputs: joints and loads by stamp.
    """

    def __init__(self, model: Model, inputs: InputBuffer) -> None:
        self.n, self.count, self.inputs = model.n, model.input_count, inputs
        self._no_load: ThreePoints = (*np.zeros((3, 6)), 0, 1, 2)
        self.clear()

    def clear(self) -> None:
        """Forget the step: other times or inputs come."""
        self._known: dict[bytes, tuple[Floats, Floats]] = {}
        self._from: tuple[float, Floats] | None = None

    def go_on_from(self, t: float, inputs: Inputs) -> None:
        """Have the actuators go on, after ``t`` (s), from where ``inputs`` had them then, and join what is known of them now little by little.

        Joints that come in change what was extrapolated. Steps that go on without having been corrected for that would take the change as a jump
        of the actuators within one step.
        """
        known, _ = self.rows(np.array([t]))
        self.clear()
        n = self.n
        self._from = (
            t,
            np.concatenate([inputs.alpha, inputs.beta]) - np.delete(known[0, : 3 * n], slice(n, 2 * n)),
        )

    def rows(self, times: Floats) -> tuple[Floats, Floats]:
        """(stages, inputs) rows as :func:`ctr_dynamics.model.state.stage_inputs` orders them at ``times`` (stages,) s from t0, and beta's
        rate (N,) m/s at the last."""
        key = times.tobytes()
        if key not in self._known:
            rows, beta_rate = self._at(times)
            if self._from is not None:
                self._join(times, rows, beta_rate)
            self._known[key] = rows, beta_rate
        return self._known[key]

    def _join(self, times: Floats, rows: Floats, beta_rate: Floats) -> None:
        """Add what is left of the difference at ``times`` to the actuators and their rates."""
        assert self._from is not None
        n, (t, difference) = self.n, self._from
        left = np.exp((t - times) / REJOIN_S)[:, None] * difference
        rate = left / -REJOIN_S
        rows[:, :n] += left[:, :n]
        rows[:, n : 2 * n] += rate[:, :n]
        rows[:, 2 * n : 3 * n] += left[:, n:]
        rows[:, 3 * n + 6 :] += rate[:, n : self.count - 2 * n - 6]
        beta_rate += rate[-1, n:]

    def _at(self, times: Floats) -> tuple[Floats, Floats]:
        """Rows and beta's rate; in one compiled call where three values of joints and load hold all times."""
        n, t0_ns, joints, load = self.n, self.inputs.t0_ns, self.inputs.joints, self.inputs.load
        assert t0_ns is not None
        ahead_ns = self.inputs.timeout_ns if self.inputs.extrapolating else 0
        first_ns, last_ns = t0_ns + round(float(times[0]) * 1e9), t0_ns + round(float(times[-1]) * 1e9)
        actuators = joints.around(first_ns, last_ns, ahead_ns)
        wrench = load.around(first_ns, last_ns) if load.stamps else self._no_load
        rows = np.empty((len(times), self.count))
        if actuators is not None and wrench is not None:
            beta_rate = np.empty(n)
            stage_rows(times, t0_ns, actuators, wrench, rows, beta_rate)
            return rows, beta_rate
        stamps = [t0_ns + round(t * 1e9) for t in times.tolist()]
        value, rate = joints.rows(stamps, ahead_ns)
        rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n : 3 * n] = value[:, :n], rate[:, :n], value[:, n:]
        rows[:, 3 * n : 3 * n + 6] = load.rows(stamps)[0] if load.stamps else 0.0
        rows[:, 3 * n + 6 :] = rate[:, n : self.count - 2 * n - 6]
        return rows, rate[-1, n:]


class RunInputs:
    """Inputs of one run, as its simulator asks for them.

    Args:
        interpolated: joints and known load.
        load: (inputs,) load of the robot file.
        effect: (inputs, p) what a change of the run's parameters adds.
        theta: (p,) the run's parameters.
    """

    def __init__(self, interpolated: InterpolatedInputs, load: Floats, effect: Floats, theta: Floats) -> None:
        self.interpolated, self.load, self.effect, self.theta = interpolated, load, effect, theta

    def __call__(self, t: float) -> Inputs:
        return self.stages(np.array([t]))[1]

    def stages(self, times: Floats) -> tuple[Floats, Inputs]:
        """Inputs at all stages of a step; see :func:`ctr_dynamics.model.state.stage_inputs`."""
        rows, beta_rate = self.interpolated.rows(times)
        corrected = np.empty_like(rows)
        corrected_rows(rows, self.load, self.effect, self.theta, corrected)
        n, last = self.interpolated.n, corrected[-1]
        return corrected, Inputs(
            last[:n],
            last[n : 2 * n],
            last[2 * n : 3 * n],
            beta_rate,
            last[3 * n : 3 * n + 3],
            last[3 * n + 3 : 3 * n + 6],
        )


def standing(inputs: Inputs) -> Inputs:
    """The same actuators at rest."""
    zero = np.zeros_like(inputs.alpha)
    return Inputs(inputs.alpha, zero, inputs.beta, zero, inputs.force, inputs.torque)
