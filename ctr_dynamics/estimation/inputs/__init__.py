"""Inputs of the estimator: validation, values by stamp, the measurement queue, and what drives a run at the stages of a step."""
