"""From hypotheses with probabilities to a verdict: residual tests, validation, separability, and what is left unexplained."""
