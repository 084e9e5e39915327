"""A discrepancy: found where there is one, with its size and correlation time, and not where there is noise only."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference import discrepancy, evidence
from ctr_dynamics.diagnosis.inference.discrepancy import (
    CorrelatedNoise,
    CorrelatedProblem,
    discrepancy_of,
    fit_beside,
)
from ctr_dynamics.diagnosis.inference.evidence import take_away
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import tail_gain
from ctr_dynamics.diagnosis.inference.map_fit import fit, fit_at
from ctr_dynamics.diagnosis.run_context import RunContext

SEEDS = range(12)


@pytest.fixture(scope="module")
def problem(recording, robot, known):
    return make_problem(robot, [recording], [known["encoder_offset", "tube1.offset_rad"]], np.ones(6, bool))


@pytest.fixture(scope="module")
def processes(problem):
    return [CorrelatedNoise(problem, time) for time in problem.options.discrepancy.times_s]


@pytest.fixture(scope="module")
def plain(problem):
    """A fit whose residual is replaced by noise of known kind."""
    found = fit(problem, (), {}, iterations=0)
    assert found is not None
    return found


def _noise(problem, rng, size, time, turn=None):
    """Whitened unit noise, and a process of ``size`` (m) and ``turn`` (rad) with ``time`` (s) on every axis, made without the module under test.

    Rotations turn with positions as the tip of a cantilever does, where ``turn`` is None.
    """
    whiten, t = problem.whiteners[0], problem.forward_models[0].recording.stamps
    root = np.linalg.cholesky(np.exp(-np.abs(t[:, None] - t) / time) + 1e-10 * np.eye(len(t)))
    values = size * root @ rng.normal(size=(len(t), 6))
    values[:, 3:] *= 1.5 / problem.robot.exposed_length if turn is None else turn / size
    return rng.normal(size=problem.size) + whiten(values)


def _gain(problem, plain, processes, residual):
    """A discrepancy beside a fit that leaves ``residual``, and what it adds to the log evidence of that fit."""
    left = fit_at(problem, plain.causes, plain.active, plain.values, residual, plain.columns)
    found = discrepancy_of(problem, left, processes)
    return found, found.log_evidence - left.log_evidence


def test_noise_alone_is_no_discrepancy(problem, processes, plain):
    for seed in SEEDS:
        residual = np.random.default_rng(seed).normal(size=problem.size)
        assert _gain(problem, plain, processes, residual)[1] < 1.0


@pytest.mark.parametrize("time", [0.03, 0.3])
def test_size_and_correlation_time_come_back(problem, processes, plain, time):
    size = 5.0 * problem.robot.tracker.noise.position.value
    found = []
    for seed in SEEDS:
        residual = _noise(problem, np.random.default_rng(seed), size, time)
        one, gain = _gain(problem, plain, processes, residual)
        assert gain > 10.0
        found.append(one)
    assert np.median([d.rms_m for d in found]) == pytest.approx(np.sqrt(3.0) * size, rel=0.25)
    assert 0.5 * time < np.median([d.correlation_time_s for d in found]) < 2.0 * time


def test_a_discrepancy_widens_what_it_can_imitate(problem, processes, plain):
    """The posterior of a constant angle is wider beside a slow process, and never narrower."""
    size = 5.0 * problem.robot.tracker.noise.position.value
    residual = _noise(problem, np.random.default_rng(0), size, 1.0)
    with_it = discrepancy_of(problem, replace(plain, residual=residual), processes).covariance
    assert with_it[0, 0] > 1.5 * plain.covariance[0, 0]


def test_rotations_have_a_size_of_their_own(problem, processes, plain):
    noise = problem.robot.tracker.noise
    size, turn = 2.0 * noise.position.value, 20.0 * noise.rotation.value
    found = []
    for seed in SEEDS:
        residual = _noise(problem, np.random.default_rng(seed), size, 0.1, turn)
        found.append(discrepancy_of(problem, replace(plain, residual=residual), processes).sizes)
    assert np.median([s[0] for s in found]) == pytest.approx(size, rel=0.4)
    assert np.median([s[1] for s in found]) == pytest.approx(turn, rel=0.4)


def test_a_fit_beside_a_discrepancy_follows_what_varies_fast(recording, robot, known):
    """A slow error looks like a lag of the tracker where the noise is white. Beside a process that has it, the lag is found."""
    lag = known["tracker_latency", "delay_s"]
    late = ForwardModel(recording, robot).predict({lag.key: 0.02})
    t, errors, expected = recording.stamps, [], []
    root = np.linalg.cholesky(np.exp(-np.abs(t[:, None] - t) / 1.0) + 1e-10 * np.eye(len(t)))
    for seed in SEEDS[:6]:
        wander = 5e-3 * root @ np.random.default_rng(seed).normal(size=(len(t), 3))
        seen = replace(recording, position=late.position + wander, quaternion=late.quaternion)
        mask = np.array([True] * 3 + [False] * 3)
        problem = make_problem(robot, [seen], [known["payload_mass", "added_kg"]], mask)
        white = fit(problem, (lag,), {})
        assert white is not None
        found = discrepancy_of(problem, white, [CorrelatedNoise(problem, 1.0)])
        beside = fit_beside(problem, white, found)
        assert beside is not None
        errors.append([white.point[lag.key] - 0.02, beside.point[lag.key] - 0.02])
        place = [q.key for q in beside.active].index(lag.key)
        expected.append(np.sqrt(found.covariance[place, place]))
    of_white, of_beside = np.sqrt(np.mean(np.square(errors), axis=0))
    assert of_beside < 0.4 * of_white
    assert of_beside < 2.0 * np.sqrt(np.mean(np.square(expected)))


def test_a_smooth_error_is_told_from_a_rough_one(problem, plain):
    t, size = problem.forward_models[0].recording.stamps, 5.0 * problem.robot.tracker.noise.position.value
    both = [CorrelatedNoise(problem, 0.3, smooth) for smooth in (False, True)]
    x = np.sqrt(3.0) * np.abs(t[:, None] - t) / 0.242  # Rasmussen and Williams (2006), eq. 4.17; 1/e at 0.3 s
    root = np.linalg.cholesky((1.0 + x) * np.exp(-x) + 1e-10 * np.eye(len(t)))
    for seed in SEEDS[:4]:
        rng = np.random.default_rng(seed)
        values = size * root @ rng.normal(size=(len(t), 6))
        values[:, 3:] *= 1.5 / problem.robot.exposed_length
        smooth = rng.normal(size=problem.size) + problem.whiteners[0](values)
        rough = _noise(problem, rng, size, 0.3)
        assert discrepancy_of(problem, replace(plain, residual=smooth), both).process.smooth
        assert not discrepancy_of(problem, replace(plain, residual=rough), both).process.smooth
        # processes that are not asked cost no more than their share of the prior
        one, among = (discrepancy_of(problem, replace(plain, residual=smooth), both[1:], n) for n in (1, 2))
        assert one.log_evidence - among.log_evidence == pytest.approx(np.log(2.0))


def test_values_come_back_from_the_axes_of_a_process(problem):
    process = CorrelatedNoise(problem, 0.3, smooth=True)
    beside = CorrelatedProblem.of(problem, process, (1e-3, 1e-2))
    values = np.random.default_rng(1).normal(size=(problem.size, 2))
    np.testing.assert_allclose(beside.undone(beside.whitened(values)), values, atol=1e-12)


def test_a_delay_may_be_many_times_its_usual_size_and_others_not(known):
    """Cauchy's distribution over the normal one, by their densities."""
    delay, other = known["tracker_latency", "delay_s"], known["actuator_latency", "delay_s"]
    width = np.hypot(delay.scale, delay.tolerance)
    for d in (0.0, 0.01, 0.1):
        expected = stats.cauchy.logpdf(d, scale=width) - stats.norm.logpdf(d, scale=width)
        assert tail_gain([other, delay], [0.3, d]) == pytest.approx(expected)
    # an average over a window is as plausible as the delay that it makes in the mean
    assert known["tracker_averaging", "window_s"].scale / 2.0 == delay.scale == other.scale


@pytest.mark.parametrize(
    ("left_m", "expected"),
    [
        ({"": 5e-3, "a": 2.5e-3, "b": 4.9e-3, "ab": 2.4e-3}, ["", "a"]),  # b takes nothing away
        ({"": 5e-3, "a": 2.5e-3, "b": 4.9e-3, "ab": 1.5e-3}, ["", "a", "ab"]),
        ({"": 5e-3, "a": 4.5e-3, "b": 4.5e-3, "ab": 4e-3}, [""]),
        ({"": 5e-3, "a": 4.5e-3, "b": 4.5e-3, "ab": 2e-3}, ["", "ab"]),
    ],
)
def test_a_cause_beside_a_discrepancy_takes_away_what_remains(left_m, expected):
    asked = [
        SimpleNamespace(keys=frozenset(names), discrepancy=SimpleNamespace(rms_m=rms_m))
        for names, rms_m in left_m.items()
    ]
    counts = take_away(asked, 0.5)
    assert [names for names, there in zip(left_m, counts, strict=True) if there] == expected


def test_priors_count_in_full_and_evidence_by_its_temperature(monkeypatch):
    """With a discrepancy as good as each hypothesis by itself, odds are those of the priors where evidence is the same."""
    priors = {"": 0.6, "a": 0.3, "b": 0.1}
    gained = {"": 0.0, "a": 0.0, "b": 4.0}
    beside = SimpleNamespace(process=None, rms_m=1e-3, log_evidence=0.0)
    monkeypatch.setattr(evidence, "every_process", lambda problem, context: [None])
    monkeypatch.setattr(evidence, "discrepancy_of", lambda *arguments: beside)
    monkeypatch.setattr(evidence, "log_prior", lambda members, pool, o, point: np.log(priors[members]))
    monkeypatch.setattr(evidence, "_refit_likeliest", lambda *arguments: None)
    asked = [
        SimpleNamespace(
            members=names, keys=frozenset(names), effects=tuple(names), fit=SimpleNamespace(point={}), discrepancy=None,
            fitted_score=gained[names] + np.log(priors[names]),
        )
        for names in priors
    ]  # fmt: skip
    options = DiagnosisOptions()
    found = SimpleNamespace(best=asked[2], no_cause=asked[0], hypotheses=asked, pool=[])
    weighed = evidence.weigh_discrepancy(found, SimpleNamespace(options=options), RunContext(workers=1))
    alone = dict(weighed.alone)
    assert alone[()] / alone["a",] == pytest.approx(2.0)
    gain = np.exp(4.0 / options.evidence.temperature)
    assert alone["b",] / alone["a",] == pytest.approx(gain / 3.0)
    outside = options.prior.discrepancy
    assert dict(weighed.beside)[()] / alone[()] == pytest.approx(outside / (1.0 - outside))
    assert weighed.leading is asked[2]


def test_a_long_recording_has_a_process_in_each_of_its_parts(problem, plain, monkeypatch):
    """Where parts are long against its correlation time, it has the size, the evidence and the scatter of one process."""
    residual = _noise(problem, np.random.default_rng(4), 5e-3, 0.03)
    found = []
    for whole in (discrepancy.WHOLE, 30):
        monkeypatch.setattr(discrepancy, "WHOLE", whole)
        monkeypatch.setattr(discrepancy, "PART", 15)  # of 40 poses, so that the last part is shorter
        process = CorrelatedNoise(problem, 0.03)
        assert max(len(size) for size, _ in process._axes) == (40 if whole > 40 else 15)
        values = np.random.default_rng(5).normal(size=(problem.size, 2))
        np.testing.assert_allclose(process.undone(process(values)), values, atol=1e-9)
        found.append(_gain(problem, plain, [process], residual))
    (one, gain), (several, also) = found
    assert also == pytest.approx(gain, rel=0.1)
    assert several.rms_m == pytest.approx(one.rms_m, rel=0.05)
    np.testing.assert_allclose(several.sizes, one.sizes, rtol=0.15)
