"""Write one case by hand: ``PYTHONPATH=test/diagnosis python -m truth --seed 1 --stratum single --output DIR``."""

from __future__ import annotations

import argparse
import time

from . import CATALOGUE, OUTSIDE, STRATA, make_case


def main() -> None:
    parser = argparse.ArgumentParser(prog="truth", description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--stratum", choices=STRATA, required=True)
    parser.add_argument("--output", required=True, metavar="DIR")
    parser.add_argument(
        "--effect",
        action="append",
        choices=[*CATALOGUE, *OUTSIDE],
        help="hide this instead of what the seed chooses; may be repeated",
    )
    options = parser.parse_args()
    begin = time.perf_counter()
    case = make_case(options.seed, options.stratum, options.output, effects=options.effect)
    print(f"{case.protocol} {case.sweep} {case.answer} in {time.perf_counter() - begin:.1f} s")


if __name__ == "__main__":
    main()
