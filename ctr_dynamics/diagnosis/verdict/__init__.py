"""From hypotheses with probabilities to a verdict: tests of the residual, what is left unexplained, the next experiment."""
