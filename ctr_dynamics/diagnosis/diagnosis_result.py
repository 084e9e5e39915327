"""What a diagnosis hands to its outputs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.configuration_mistakes import FoundMistake
from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.discrepancy import Discrepancy
from ctr_dynamics.diagnosis.inference.evidence import WeighedHypotheses
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.residual_tests import Whiteness, rms
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities
from ctr_dynamics.diagnosis.inference.tolerance_evidence import ToleranceEvidence
from ctr_dynamics.diagnosis.learned.learn import Learning
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.verdict.separability import Cause
from ctr_dynamics.diagnosis.verdict.unexplained_force import UnexplainedForce
from ctr_dynamics.diagnosis.verdict.validation import Validation
from ctr_dynamics.diagnosis.whitening import noise_floor
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]


@dataclass
class Diagnosis:
    """Outcome of a diagnosis; docs/diagnosis.md explains the verdicts.

    Attributes:
        verdict: `clean`, `named`, `named_with_remainder`, `ambiguous`, `unknown` or `not_excited`.
        causes: of the verdict.
        cause_sets: sets of effects with their probabilities, likeliest first.
        tested, not_observable: effect IDs.
        numerics: rms of the discretisation error in m, ``time_error_m`` and ``space_error_m``.
        nominal_rms: m, of the model as the robot file has it.
        recalibrated, extended: fits without and with the causes; None where a configuration mistake ended the diagnosis.
        residual_nominal, residual_recalibrated, residual_extended: (s, 6) of every recording, m and rad.
        whiteness_recalibrated, whiteness_extended: tests of what the fits leave.
        mistake: of the configuration, with the misfit that it makes.
        sensitivities: at the extended fit, where causes are named.
        discrepancy: what remains beside the causes of the verdict, or beside none, where it is more than noise.
        seconds: of the diagnosis.
        learning: what was learned from what no cause explains; None where it was not asked for.
        tolerances: evidence that those of the robot file are too tight; None where it was not asked for. Verdict `tolerances` rests on it.
    """

    robot: Robot
    recordings: list[Recording]
    options: DiagnosisOptions = field(default_factory=DiagnosisOptions)
    verdict: str = "clean"
    causes: list[Cause] = field(default_factory=list)
    cause_sets: list[tuple[tuple[str, ...], float | None]] = field(default_factory=lambda: [((), 1.0)])
    tested: list[str] = field(default_factory=list)
    not_observable: list[str] = field(default_factory=list)
    numerics: dict[str, float] = field(default_factory=dict)
    nominal_rms: float = math.nan
    problem: Problem | None = None
    recalibrated: Fit | None = None
    extended: Fit | None = None
    search: WeighedHypotheses | None = None
    whiteness_recalibrated: Whiteness | None = None
    whiteness_extended: Whiteness | None = None
    validation: Validation | None = None
    mistake: FoundMistake | None = None
    notes: list[str] = field(default_factory=list)
    seconds: float = 0.0
    tolerances: ToleranceEvidence | None = None
    residual_nominal: list[Floats] = field(default_factory=list)
    residual_recalibrated: list[Floats] = field(default_factory=list)
    residual_extended: list[Floats] = field(default_factory=list)
    sensitivities: Sensitivities | None = None
    unexplained_force: UnexplainedForce | None = None
    discrepancy: Discrepancy | None = None
    learning: Learning | None = None

    @property
    def fraction_of_misfit(self) -> float | None:
        """Fraction of the re-calibrated model's squared misfit beyond noise that is the discrepancy; None without one."""
        if self.discrepancy is None or self.recalibrated is None:
            return None
        residual = np.concatenate(self.residual_recalibrated)[:, :3]
        beyond = rms(residual) ** 2 - noise_floor(self.robot) ** 2
        return min(1.0, self.discrepancy.rms_m**2 / beyond) if beyond > 0.0 else 1.0
