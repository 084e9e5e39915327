"""Truth for the tests of the diagnosis: an independent simulator of concentric tube robots with hidden effects.

It shares no code with the package's model: own coordinates in space, own scheme in time, own physics of every effect. `make_case` writes bags
and a sealed answer; `python -m truth` (in this folder's parent) does it by hand.
"""

from .cases import ROBOT, STRATA, Case, make_case
from .effects import CATALOGUE, OUTSIDE

__all__ = ["CATALOGUE", "OUTSIDE", "ROBOT", "STRATA", "Case", "make_case"]
