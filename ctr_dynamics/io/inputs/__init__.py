"""From what a bag or a driver sends to the estimator's inputs: which topic, type, names and units."""
