"""Estimation: the filter on the model's fields, and the estimator that drives both from stamped inputs."""
