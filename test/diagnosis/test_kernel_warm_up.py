"""The dry run of a diagnosis compiles what the sensitivities of every candidate need: nobody waits for the compiler in the middle of one."""

import json
import subprocess
import sys

PROGRAM = """
import json

import numpy as np

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.recalibration import nuisances_of
from ctr_dynamics.diagnosis.inference.candidates import candidates
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.sensitivities import sensitivities_at
from ctr_dynamics.diagnosis.kernel_warm_up import rest_recording, warm_up
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.kernels.collocation_sequence import advance_columns_often, advance_stages_often
from ctr_dynamics.robot_files import load_robot

robot, runs = load_robot("till2020_tissue"), (advance_stages_often, advance_columns_often)
warm_up(robot)
before = [set(map(str, run.signatures)) for run in runs]
recording = rest_recording(robot)
problem = make_problem(robot, [recording], nuisances_of(robot), np.ones(6, bool), DiagnosisOptions())
pool = candidates(effect_quantities(robot), recording.position)
assert sensitivities_at(problem, {}, pool, RunContext(workers=1)) is not None
print(json.dumps([len(set(map(str, run.signatures)) - known) for run, known in zip(runs, before)]))
"""


def test_sensitivities_of_all_candidates_compile_nothing_after_the_dry_run():
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=900, check=True
    )
    assert json.loads(done.stdout.splitlines()[-1]) == [0, 0]
