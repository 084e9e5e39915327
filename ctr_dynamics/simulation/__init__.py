"""Simulated scenarios: motions and loads from a YAML file, run through the model and written as a bag of
driver messages.
"""

from ctr_dynamics.simulation.scenario import Scenario, load_scenario, scenario_names
from ctr_dynamics.simulation.scenario_run import SimulatedRecording, simulate, write_recording

__all__ = ["Scenario", "SimulatedRecording", "load_scenario", "scenario_names", "simulate", "write_recording"]
