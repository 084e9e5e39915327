"""What the simulator is driven by: input signals with one run's corrections."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs

from .signals import Signal

Floats = NDArray[np.float64]
_NO_LOAD = np.zeros(6)


class Actuation:
    """Input signals with the corrections ``shift`` (inputs,) of one run, for the simulator.

    ``known`` keeps the bare signals of one step, which both runs share.
    """

    def __init__(
        self,
        model: Model,
        t0_ns: int,
        joints: Signal,
        load: Signal,
        extrapolate_ns: int,
        shift: Floats,
        known: dict,
    ) -> None:
        self.n, self.count, self.t0_ns, self.joints, self.load = (
            model.n,
            model.input_count,
            t0_ns,
            joints,
            load,
        )
        self.extrapolate_ns, self.shift, self.known = extrapolate_ns, shift, known

    def __call__(self, t: float) -> Inputs:
        return self.stages(np.array([t]))[1]

    def stages(self, times: Floats) -> tuple[Floats, Inputs]:
        """Inputs at all stages of a step; see :func:`ctr_dynamics.model.simulator.stage_inputs`."""
        n = self.n
        key = (float(times[0]), float(times[-1]))
        if key not in self.known:
            parts: list[Floats] = []
            for t in times.tolist():
                time_ns = self.t0_ns + round(t * 1e9)
                value, rate = self.joints.at(time_ns, self.extrapolate_ns)
                load = self.load.at(time_ns)[0] if self.load.stamps else _NO_LOAD
                parts += [value[:n], rate[:n], value[n:], load, rate[n : self.count - 2 * n - 6]]
            self.known[key] = np.concatenate(parts).reshape(len(times), self.count), rate[n:]
        bare, beta_rate = self.known[key]
        rows = bare + self.shift
        last = rows[-1]
        return rows, Inputs(
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
