"""What rivals of the filter have in common: they compete by how well each foretells the next position (prequential evidence, Dawid 1984)."""

from __future__ import annotations

MEMORY_S = 10.0
"""s, for which evidence counts: some periods of slow motion, and short against a robot's day. It is the same for all, as logarithms of evidence
compare only where they are forgotten equally fast."""

PRIOR = 0.01
"""Probability of a robot or tracker that departs from its file in one way or another. The file is trusted until evidence of a hundred to one. It is
the same for every way, so that none is preferred before anything was measured."""

DRIFT_S = 1.0
"""s, in which the open-loop run of a good model goes astray by about the tracker's noise."""

FREEDOM = 3.0
"""Degrees of freedom of Student's distribution, where outliers are not to count: 3 have the heaviest tails for which the variance exists."""
