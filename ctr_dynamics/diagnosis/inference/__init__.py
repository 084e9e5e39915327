"""From recordings and a forward model to hypotheses with probabilities: calibration, screening, hypotheses, evidence."""
