"""Input signals: all stages of a step at once against one after another, and what drives both runs."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.estimation.inputs.run_inputs import InterpolatedInputs
from ctr_dynamics.sensing import ActuatorModel, ActuatorSignal
from ctr_dynamics.sensing.interpolation import Signal

MS = 1_000_000
RNG = np.random.default_rng(5)
PLAIN = ActuatorModel(np.ones(2), np.zeros(2), np.zeros(2), np.zeros(2))


def line(before, after, begin, end, times):
    """Values and rates (times, size) on the line between two stamps."""
    rate = (after - before) * (1e9 / (end - begin))
    ahead = (np.array(times) - begin) * 1e-9
    return before + ahead[:, None] * rate, np.tile(rate, (len(times), 1))


def signal(make):
    """Seven stamps with four values, 10 ms apart."""
    made = make()
    for k in range(7):
        made.add(10 * k * MS, RNG.normal(size=4))
    return made


@pytest.fixture(params=["plain", "backlash", "delayed"])
def stamped(request):
    makes = {
        "plain": lambda: ActuatorSignal(PLAIN),
        "backlash": lambda: ActuatorSignal(PLAIN.changed(backlash=np.array([0.3, 0.0]))),
        "delayed": lambda: ActuatorSignal(PLAIN.changed(delay=4e-3)),
    }
    return signal(makes[request.param])


@pytest.mark.parametrize("load", ["none", "held", "moving"])
@pytest.mark.parametrize(
    ("first", "extrapolate"),
    [
        (-9, 0),
        (-1, 0),
        (0, 0),
        (2, 0),
        (7, 0),
        (9, 0),
        (9.5, 0),
        (13.5, 0),
        (10, 0),
        (58, 0),
        (59.5, 30),
        (58, 30),
        (70, 30),
        (70, 5),
        (70, 0),
    ],
)
def test_stages_together_are_the_stages_one_by_one(stamped, first, extrapolate, load):
    t0_ns = -3 * MS
    wrench = Signal(6)
    for k in range({"none": 0, "held": 1, "moving": 9}[load]):
        wrench.add((10 * k - 12) * MS, RNG.normal(size=6))
    inputs = SimpleNamespace(
        t0_ns=t0_ns, joints=stamped, load=wrench, timeout_ns=extrapolate * MS, extrapolating=extrapolate > 0
    )
    signals = InterpolatedInputs(SimpleNamespace(n=2, input_count=14), inputs)
    stamps = [round((first + part) * MS) for part in (0.4359, 0.718, 1.0)]
    rows, beta_rate = signals.rows(np.array([(stamp - t0_ns) * 1e-9 for stamp in stamps]))
    assert rows.shape == (3, 14)
    for k, stamp in enumerate(stamps):
        value, rate = stamped.at(stamp, extrapolate * MS)
        force = wrench.at(stamp)[0] if wrench.stamps else np.zeros(6)
        wanted = np.concatenate([value[:2], rate[:2], value[2:], force, rate[2:]])
        np.testing.assert_allclose(rows[k, :12], wanted[:12], rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(rows[k, 12:], rate[2:], rtol=1e-12)
    np.testing.assert_allclose(beta_rate, rate[2:], rtol=1e-12)


def test_a_value_between_two_samples_lies_on_their_line():
    made = signal(lambda: Signal(4))
    times = [21 * MS, 24 * MS, 30 * MS]
    wanted = line(made.values[2], made.values[3], 20 * MS, 30 * MS, times)
    for k, found in enumerate(zip(*made.rows(times), strict=True)):
        np.testing.assert_allclose(found[0], wanted[0][k], rtol=0, atol=1e-15)
        np.testing.assert_allclose(found[1], wanted[1][k], rtol=1e-15)
