"""Diagnosis: from measured bags to what the simulation gets wrong, its cause, and what the extended model gains.

:mod:`~ctr_dynamics.diagnosis.pipeline` runs the stages in this order. Every module says what goes in and what comes out.

| stage | modules |
|---|---|
| data | `recording` |
| configuration | `configuration_mistakes` |
| forward model | `forward_model`, `whitening` |
| re-calibration | `inference.recalibration`; fits: `fit_problem`, `map_fit`, `gaussian_posterior`, `discretisation_error` |
| screening | `inference.candidates`, `inference.sensitivities`, `inference.screening` |
| hypotheses | `inference.hypothesis_search`, `inference.search_moves`, `inference.hypotheses`, `inference.contact_plane` |
| evidence | `inference.evidence` |
| validation | `verdict.validation`, `inference.residual_tests` |
| verdict | `verdict.separability`, `verdict.decision`, `verdict.unexplained_force`; then `next_experiment` |
| output | `output.findings`, `output.findings_report`, `output.robot_export`, `output.summary_text` |

:mod:`~ctr_dynamics.diagnosis.request` goes from paths to files, and `from_bags` is its public function. All numbers are in
`diagnosis_options`; progress, workers and time are in `run_context`.
"""
