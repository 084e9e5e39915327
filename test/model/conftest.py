"""Makes the helpers beside the tests importable.

`model_cases` builds robots, `model_oracle` is the plain NumPy twin.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
