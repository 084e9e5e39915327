"""Every number that a diagnosis works with, its unit and the reason for its value; the table of docs/diagnosis_options.md.

One group for each stage, in the order of the stages. The values were chosen on cases of the truth generator (test/diagnosis/truth).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

T = TypeVar("T")
NOISE = "deviations"  # of the sum of squares that noise alone gives
LOG = "log evidence"
FRACTION = "fraction"
COUNT = "count"


def option(value: T, unit: str, reason: str) -> T:
    """A field with its unit and the reason for its value."""
    made: T = field(default=value, metadata={"unit": unit, "reason": reason})
    return made


@dataclass(frozen=True)
class RecordingOptions:
    """Data: what is used of a bag."""

    shortest_s: float = option(2.0, "s", "joints and tracker together; less shows too little of a vibration")
    longest_s: float = option(1000.0, "s", "joints that fit into memory with all that is kept of them")
    gap_s: float = option(0.1, "s", "without joint states; the motion in a longer gap is unknown")
    gap_periods: float = option(
        3.0, "periods of the joints", "likewise, for slow or uneven joints: two lost readings in a row"
    )
    settling_s: float = option(0.5, "s", "after a gap; vibration from the unseen motion persists")
    pause_s: float = option(
        10.0, "s", "without joint states, or by which the clock was set: another recording"
    )
    start_s: float = option(0.1, "s", "of joint states that show whether the robot stands at the start")
    start_rad: float = option(
        0.01, "rad", "rotation within the start, beside the encoders' noise, that is rest"
    )
    start_m: float = option(2e-4, "m", "translation within the start that is rest")
    start_noise: float = option(6.0, "deviations", "of the encoders' noise in a peak-to-peak value of rest")
    unsettled_s: float = option(2.0, "s", "until an unknown initial motion has died away; 1 s leaves 0.3 mm")
    first_load_s: float = option(0.1, "s", "a first load that comes this early acts from the start")
    coarse_s: float = option(
        1e-3,
        "s",
        "resolution of stamps that is made good; at 0.1 m/s finer ones move the tip by less than its noise",
    )
    coarse_steps: float = option(
        3.0, "of the resolution", "in an interval at least; fewer are missing readings of an even sequence"
    )
    coarse_even: float = option(
        0.9, "of the intervals", "that an even device explains, pauses apart; else it is uneven itself"
    )


@dataclass(frozen=True)
class ForwardModelOptions:
    """Forward model: resolution and differences."""

    nodes: int = option(
        10, COUNT, "from plate to tip to begin with; more where the data can see the difference"
    )
    fine_nodes: int = option(
        16, COUNT, "for mistaken geometries and for scenarios, whose error is not measured"
    )
    dt_s: float = option(0.003, "s", "the estimator's step")
    difference: float = option(1e-3, "of the scale", "for derivatives of the inputs and of the tracker chain")
    joint_gap_s: float = option(0.05, "s", "between joint states; straight lines across longer gaps")

    @property
    def fine(self) -> ForwardModelOptions:
        """The same with ``fine_nodes``."""
        return replace(self, nodes=self.fine_nodes)


@dataclass(frozen=True)
class StepOptions:
    """Steps in time: as long as the data can tell no difference."""

    limit: float = option(
        3.0,
        "whitened",
        "change of a prediction by longer steps; it is corrected where it is measured, and a tenth of it changes with the fit",
    )
    window: int = option(128, "shortest steps", "in which steps are even, and the longest of them")


@dataclass(frozen=True)
class ConfigurationOptions:
    """Configuration mistakes: units, signs and orders."""

    gross: float = option(8.0, "noise rms", "misfit below which no mistake is looked for")
    longest_s: float = option(20.0, "s", "of a recording that shows a gross mistake, whatever comes after")
    improvement: float = option(0.25, "of the misfit", "what a mistake may leave when it is undone")


@dataclass(frozen=True)
class CalibrationOptions:
    """Calibration: maximum a posteriori fits."""

    tolerance_limit: float = option(2.9, "tolerances", "a value farther off is a finding and needs a cause")
    likely_together: float = option(
        0.95, "probability", "of the squares of all departures in tolerances; beyond, they imitate a cause"
    )
    reach: float = option(
        4.0, "tolerances", "a large misfit would carry all nuisances away and hide its cause"
    )
    inflation: float = option(1.5, "of posterior deviations", "errors of tuning cases were that much larger")
    iterations: int = option(10, COUNT, "steps of a fit")
    first_iterations: int = option(
        2, COUNT, "of the first fit; what these leave beyond noise may be a matter of phases"
    )
    renewals: int = option(2, COUNT, "exact Jacobians of a fit; Broyden's updates serve between them")
    settled: float = option(0.05, "cost", "what gains less is not worth a simulation")
    surprise: tuple[float, ...] = option(
        (12.0, 6.0, 4.0),
        "promised gains",
        "first, second, later steps; a fit that cannot reach its limit so is ended",
    )
    damping: tuple[float, ...] = option(
        (1e2, 1e3, 1e4, 1e5), "prior precisions", "tried in turn where no part of a full step lowers the cost"
    )
    backtracking: float = option(0.35, "of the step", "each time it does not lower the cost")
    parts: int = option(2, COUNT, "lengths of a step that are tried before damping")
    stale: float = option(0.3, "of the step", "error of a prediction from which the Jacobian may be renewed")
    travelled: float = option(3.0, "whitened", "sum of these errors from which it is renewed")
    first_part: float = option(
        0.03, "of a recording", "fitted before all of it, where a first fit leaves more than noise"
    )
    growth: float = option(1.4, "times", "from a part that is explained to the next")
    least_growth: float = option(1.05, "times", "where that does not help, it is no matter of phases")
    difference: float = option(
        0.02, "of the scale", "for columns of shape parameters of an effect that was off"
    )


@dataclass(frozen=True)
class DiscretisationOptions:
    """Discretisation error: the solver's own error against finer solutions."""

    deviation: float = option(0.6, "of the difference", "what stays free to vary after the correction")
    space_limit: float = option(
        20.0,
        "whitened",
        "difference to twice the nodes from which these are used; below, it is corrected, and a tenth of it changes with the fit",
    )
    most_nodes: int = option(40, COUNT, "cost grows with them")
    time_limit: float = option(
        20.0, "whitened", "a correction is right where it was measured; a tenth of it changes with the fit"
    )
    time_left: float = option(
        3.0, "whitened", "difference of a quarter of the step from half of it, likewise"
    )
    shortest_s: float = option(
        0.0015, "s", "step of fits; what is left of the error stays in the covariance, and cost grows"
    )
    renewed: float = option(
        3.0, "whitened", "change of the correction from which that of another point counts"
    )
    shorter: tuple[tuple[float, float], ...] = option(
        ((0.5, 1.0), (2.0 / 3.0, 1.4), (0.8, 2.2)),
        "of the step",
        "shorter steps in the order of trial, each with the factor from its difference to that of half a step",
    )


@dataclass(frozen=True)
class PriorOptions:
    """Candidates: probabilities before the data, and where places start."""

    clean: float = option(0.5, "probability", "of no cause")
    single: float = option(0.38, "probability", "of one cause, shared among the effects")
    pair: float = option(0.1, "probability", "of two causes")
    triple: float = option(0.02, "probability", "of three causes")
    discrepancy: float = option(
        0.1, "probability", "of something outside the catalogue, causes or none beside it"
    )
    behind_plane: float = option(0.1, FRACTION, "of the positions behind a contact plane to begin with")


@dataclass(frozen=True)
class ScreeningOptions:
    """Screening: linear evidence of every candidate."""

    finite_size_dt_s: float = option(
        0.005, "s", "step for finite sizes; their change exceeds its error in time"
    )
    larger_sizes: int = option(
        3, COUNT, "finite sizes beyond the largest, as long as each leaves less: 3.4 times as far"
    )
    size_growth: float = option(
        1.5,
        "of the one before",
        "each of them, and other sizes of the best hypothesis; a fit looks for the best size up to 1.7 times as large",
    )
    least_gain: float = option(1.0, LOG, "below, a candidate is not worth a fit")
    candidates: int = option(8, COUNT, "that are fitted; the true cause was among them in 87 of 87 cases")
    spare: int = option(3, COUNT, "more that are looked at, since presets of one effect count once")


@dataclass(frozen=True)
class ContactPlaneOptions:
    """Contact plane: looked for from the time of divergence on."""

    diverged: float = option(0.3, "of the large residuals", "from there measurement and model have diverged")
    diverged_noise: float = option(5.0, "noise rms", "the least residual that counts as diverged")
    first: float = option(2.0, "noise rms", "from there the residual shows the direction of the normal")
    sudden_s: float = option(0.1, "s", "from there to the divergence; what grows slower is no impact")
    lead_s: float = option(0.06, "s", "before the divergence that counts in a fit")
    first_spans_s: tuple[float, ...] = option((0.05, 0.13), "s", "after the divergence, for every start")
    spans_s: tuple[float, ...] = option((0.25, 0.5, 1.0), "s", "after the divergence, for the best one")
    stiffnesses: tuple[float, ...] = option((120.0, 400.0), "N/m", "to begin with")
    factors: tuple[float, ...] = option(
        (1.0, 0.5, 2.0), "of the stiffness", "starts of fits with all nuisances"
    )
    sure: float = option(2e-3, "of the squares", "what leaves no more needs no other start")
    no_plane: float = option(0.5, "of the squares", "what leaves more in a first span is no plane")
    explained: float = option(0.9, "of the squares", "that a plane must explain in a span")
    depth_m: float = option(2e-3, "m", "of the tip behind the plane where it is noticed first")
    evaluations: int = option(12, COUNT, "derivatives of the residual for a span")


@dataclass(frozen=True)
class SearchOptions:
    """Hypothesis search: which sets of causes are fitted."""

    batch: int = option(
        2, COUNT, "first fits, which others must be able to beat; fixed, whatever the workers"
    )
    beam: int = option(
        4,
        COUNT,
        "sets of causes that explain most of a first part, to which more causes are added where it ends",
    )
    half_left: float = option(
        0.55,
        "of the misfit",
        "where a part ends: a further cause that leaves more is no half of two that explain it",
    )
    give_up: float = option(8.0, "deviations", "of the cost above the best one's at which a fit is given up")
    enough: float = option(2.0, "times the noise", "what leaves no more ends the trial of other sizes")
    nearby_sizes: tuple[float, float] = option(
        (0.5, 1.7), "of a finite size", "where the best one is looked for"
    )
    nearby_evaluations: int = option(12, COUNT, "simulations of that search")
    nearby_accuracy: float = option(0.01, "of a finite size", "of that search")
    large_misfit: float = option(80.0, NOISE, "from which large sizes and a contact plane are tried")
    little_left: float = option(2.0, NOISE, "what leaves no more makes these trials needless")
    much_left: float = option(4.0, NOISE, "from which more hypotheses are tried")
    suspicious_p: float = option(
        0.01,
        "probability",
        "of the residual tests, below which causes are tried at large sizes: needlessly in one bag of a hundred",
    )
    poor_fit: float = option(0.3, "of the misfit", "two causes that leave more are not made right by a third")
    acceptable: float = option(1.5, "times the noise", "squares; a hypothesis that leaves more is not right")
    far_from_noise: float = option(
        10.0,
        "times the noise",
        "squares; a poor fit, or three causes, that leaves more is not searched for again",
    )
    further_gain: float = option(5.0, LOG, "that a further cause must add")
    further_slack: float = option(2.0, LOG, "by which the linear estimate of that may be wrong")
    further: int = option(4, COUNT, "further causes that are fitted beside a leader")
    leaders: int = option(2, COUNT, "single causes beside which others are looked for")
    leader_margin: float = option(3.0, LOG, "to the best single cause")
    leader_margin_poor: float = option(20.0, LOG, "the same where the best one leaves much")
    pair_effects: int = option(5, COUNT, "that leave least by themselves, whose pairs are all fitted")
    contenders: int = option(3, COUNT, "hypotheses that are fitted again with exact Jacobians")
    contender_margin: float = option(6.0, LOG, "to the best one within which they may be")
    alternative_distance: float = option(12.0, "whitened", "separation within which an alternative is fitted")
    alternative_likeness: float = option(
        0.12, "of the size", "separation within which shapes are alike: large effects are not linear enough"
    )
    alternatives: int = option(3, COUNT, "for each cause, and for each two")
    pair_rankings: int = option(6, COUNT, "best pairs by linear evidence that are fitted in a round")
    pair_margin: float = option(6.0, LOG, "by which such a pair may look worse than the best hypothesis")
    pair_nonlinear: float = option(
        0.01, "of the explained misfit", "more of it, since columns hold nearby only"
    )
    rounds: int = option(3, COUNT, "of alternatives and pairs, each from a new best hypothesis")
    time_error: float = option(
        5.0, "times the squares", "of the error in time within which a rest may be that"
    )
    left: float = option(0.03, "of the misfit", "that a hypothesis may leave")
    left_impacts: float = option(0.15, "of the misfit", "the same where the error in time is as large")
    early_s: float = option(1.0, "s", "after divergence, to which causes with impacts are fitted first")
    early_spans_s: tuple[float, ...] = option((2.0, 4.0), "s", "after it, before the whole recording")
    early_leaders: int = option(2, COUNT, "early hypotheses that are fitted to longer spans")


@dataclass(frozen=True)
class EvidenceOptions:
    """Evidence: from fits to probabilities."""

    temperature: float = option(1.6, "1", "divides log evidence; a judgement against overconfidence")
    predictions: int = option(8, COUNT, "likeliest hypotheses that predict the validation bags")
    outvoted: float = option(100.0, LOG, "of fitted bags that no prediction as good as the noise makes good")
    set_probability: float = option(0.95, "probability", "that the listed sets of causes hold together")


@dataclass(frozen=True)
class DiscrepancyOptions:
    """Discrepancy: what models leave as a correlated process."""

    times_s: tuple[float, ...] = option(
        (0.03, 0.1, 0.3, 1.0, 3.0), "s", "correlation times; slower is the drift of the tracker"
    )
    smallest: float = option(0.1, "of the position noise", "size that no bag of usual length shows")
    largest: float = option(100.0, "of the position noise", "larger is a configuration mistake")
    hypotheses: int = option(12, COUNT, "likeliest that are weighed with it, that without causes beside them")
    refitted: int = option(
        6,
        COUNT,
        "likeliest that are fitted again with it where much more than noise is left; a few simulations each",
    )
    dominant: float = option(0.5, "of the misfit", "that causes explain which are named beside a remainder")


@dataclass(frozen=True)
class ResidualTestOptions:
    """Residual tests: whether what is left is noise."""

    lags: int = option(20, COUNT, "of the Ljung-Box test: half a second at 40 Hz")
    noise_p: float = option(1e-4, "probability", "below which what is left is not noise")


@dataclass(frozen=True)
class ValidationOptions:
    """Validation: bags that were not fitted."""

    block_s: float = option(0.5, "s", "of the bootstrap; longer than a period of the first mode")
    draws: int = option(2000, COUNT, "of the bootstrap")
    predicted: float = option(1.15, "NIS / dof", "up to which a bag is predicted down to the noise")
    left: float = option(0.2, "of the misfit", "there that may be left of it")


@dataclass(frozen=True)
class ToleranceOptions:
    """Tolerances: whether those of the robot file are too tight."""

    too_tight: float = option(
        0.02,
        "probability",
        "of tolerances too tight by one factor, as of three causes: much is wrong at once",
    )
    widest: float = option(5.0, "tolerances", "beyond it a departure is a cause by itself")
    refits: int = option(3, COUNT, "of a hypothesis with the likeliest factor, which may then be another")
    factors: int = option(12, COUNT, "a fifth apart at most, finer than one draw can tell")
    substantial: float = option(
        1.15, LOG, "half of ln 10, from which Jeffreys (1961) calls evidence for wider tolerances substantial"
    )


@dataclass(frozen=True)
class VerdictOptions:
    """Verdict: what is named."""

    named: float = option(0.9, "probability", "from which causes are named")
    needed_gain: float = option(4.0, LOG, "priors included, that causes must gain over fewer or none")
    separation: float = option(5.0, "whitened", "sensitivities that are nearer cannot be told apart")
    separation_fitted: float = option(
        3.0, "deviations", "the same between fits: root of the difference of costs"
    )
    observable: float = option(3.0, "whitened", "size of a sensitivity at prior scale that a bag can see")
    strong: float = option(24.0, "whitened", "size that can be told from most others")
    excited: float = option(0.2, "of the effects", "that a bag must show strongly")


@dataclass(frozen=True)
class UnexplainedForceOptions:
    """Unexplained force: description of what no cause explains."""

    start_s: float = option(0.5, "s", "at the beginning that is left out")
    fewest: int = option(20, COUNT, "poses below which nothing is described")
    stiff: float = option(0.1, "of the compliance", "directions below say nothing about a force")
    lowest_hz: float = option(0.1, "Hz", "of the periodogram")
    highest_hz: float = option(18.0, "Hz", "below half of a 40 Hz tracker's rate")
    frequencies: int = option(1800, COUNT, "of the periodogram, 0.01 Hz apart")
    periodic: float = option(0.5, "of the power", "in one frequency from which it is stated")


@dataclass(frozen=True)
class LearnedForceOptions:
    """Learned force: what is learned from what no cause explains."""

    fitted: float = option(0.6, FRACTION, "of each bag that is fitted where there are none for validation")
    memory_s: tuple[float, ...] = option(
        (0.05, 0.2, 0.8), "s", "delays to begin with: a fit reaches from one to the next"
    )
    sizes: tuple[float, ...] = option(
        (0.0, 0.1, 0.15, 0.25, 0.4, 0.6, 1.0, 1.5, 2.5, 4.0, 6.0, 10.0, 15.0, 25.0, 40.0),
        "of the position noise",
        "of what stays unexplained; coarser steps leave noise to terms",
    )
    widths_N: tuple[float, ...] = option(
        (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0),
        "N",
        "priors of coefficients, of which the evidence chooses",
    )
    longest_s: float = option(
        20.0, "s", "of each bag from which terms are chosen; all of it is fitted afterwards"
    )
    dt_s: float = option(0.005, "s", "shortest step on the measured path, where errors in time do not add up")
    guidance: tuple[float, ...] = option(
        (1.0, 1.0, 0.3), "of the tip's stiffness", "spring to the measured path, round after round"
    )
    renewals: int = option(3, COUNT, "exact Jacobians of the fit to free simulations")
    slide_m: float = option(1e-3, "m", "of a translation that counts as moving; less looks like a constant")


@dataclass(frozen=True)
class DesignOptions:
    """Next experiment: what motions are put together from."""

    rivals: int = option(3, COUNT, "likeliest ones; the smallest separation counts")
    blocks: int = option(12, COUNT, "random motions that are simulated; more rarely hold a better one")
    block_s: float = option(5.0, "s", "of a motion: several periods of a slow robot")
    pause_s: float = option(0.5, "s", "at rest behind a motion, in which vibrations show by themselves")
    longest_s: float = option(
        44.0, "s", "of the experiment: a minute of a robot's time, minutes of a diagnosis"
    )
    turning_points: tuple[int, ...] = option(
        (1, 2, 4, 8, 14), COUNT, "of a spline: slow and wide to fast and small"
    )
    fastest_rad_s: float = option(3.0, "rad/s", "half a turn in a second, as laboratory drives make")
    fastest_m_s: float = option(0.02, "m/s", "likewise, of a lead screw")
    farthest_rad: float = option(6.3, "rad", "one turn; friction and wires of drives rarely allow more")
    farthest_translation: float = option(0.15, "of the exposed length", "tubes keep most of their overlap")
    deflection: float = option(
        0.4,
        "of the exposed length",
        "by a hung weight: 0.4 to 1.1 % of added strain on five robots; tubes are elastic to about 1 %",
    )
    least_stability: float = option(
        0.3, "of that at rest", "the measure falls as the root of the way to a snap: a tenth of it is left"
    )
    least_gain: float = option(0.03, "of the separation", "a motion that adds less is not worth its time")
    seed: int = option(1, COUNT, "of the random motions; the same diagnosis proposes the same experiment")


@dataclass(frozen=True)
class ReportOptions:
    """Output: what is said and shown."""

    numerics_limit: float = option(0.2, "noise rms", "discretisation error that is within the noise")
    shown: int = option(12, COUNT, "hypotheses in figures and tables of the report")


@dataclass(frozen=True)
class DiagnosisOptions:
    """All groups, in the order of the stages."""

    recording: RecordingOptions = RecordingOptions()
    forward_model: ForwardModelOptions = ForwardModelOptions()
    steps: StepOptions = StepOptions()
    configuration: ConfigurationOptions = ConfigurationOptions()
    calibration: CalibrationOptions = CalibrationOptions()
    discretisation: DiscretisationOptions = DiscretisationOptions()
    prior: PriorOptions = PriorOptions()
    screening: ScreeningOptions = ScreeningOptions()
    contact_plane: ContactPlaneOptions = ContactPlaneOptions()
    search: SearchOptions = SearchOptions()
    evidence: EvidenceOptions = EvidenceOptions()
    discrepancy: DiscrepancyOptions = DiscrepancyOptions()
    residual_tests: ResidualTestOptions = ResidualTestOptions()
    validation: ValidationOptions = ValidationOptions()
    verdict: VerdictOptions = VerdictOptions()
    tolerances: ToleranceOptions = ToleranceOptions()
    unexplained_force: UnexplainedForceOptions = UnexplainedForceOptions()
    learned_force: LearnedForceOptions = LearnedForceOptions()
    design: DesignOptions = DesignOptions()
    report: ReportOptions = ReportOptions()


def groups() -> Iterator[tuple[str, Any]]:
    """Name and default of every group."""
    options = DiagnosisOptions()
    for f in fields(options):
        yield f.name, getattr(options, f.name)


def rows(group: Any) -> Iterator[tuple[str, Any, str, str]]:
    """Name, value, unit and reason of every option of a group."""
    for f in fields(group):
        yield f.name, getattr(group, f.name), f.metadata["unit"], f.metadata["reason"]
