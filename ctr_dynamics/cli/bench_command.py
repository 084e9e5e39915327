"""`ctr-dynamics bench`: performance figures as JSON, plots and text."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.io.atomic_files import atomic_file, check_targets, output_folder
from ctr_dynamics.io.shipped_bags import shipped_bag


def bench(
    output: Annotated[
        Path, typer.Option("--output", metavar="DIR", help="Folder for bench.json and the plots.")
    ] = Path("bench"),
    quick: Annotated[bool, typer.Option("--quick", help="Few and short measurements.")] = False,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE", help="Also write the figures as a Markdown page.")
    ] = None,
    bag: Annotated[
        Path | None,
        typer.Option(metavar="BAG", help="Bag of till2020_tissue to replay; default: the shipped one."),
    ] = None,
    fleet: Annotated[
        int,
        typer.Option(
            "--fleet",
            metavar="N",
            min=0,
            help="Measure the filter's consistency alone: N bags of each robot of the fleet.",
        ),
    ] = 0,
) -> int:
    """Measure cost per step, real-time ratios and tick times; with --fleet errors, NEES and NIS of the filter.

    Figures depend on the machine and on what else it does: both are recorded, and costs are given as multiples
    of a plain sweep measured in the same run as well.
    """
    # imported late: --help must not wait for the compiled model
    from ctr_dynamics.benchmarks.bench_report import page as as_page
    from ctr_dynamics.benchmarks.bench_report import plots, text
    from ctr_dynamics.benchmarks.suite import measure

    def say(part: str) -> None:
        print(f"bench: {part}", file=sys.stderr, flush=True)

    check_targets({"page": page}, {"bag": bag})
    output_folder(output)
    if fleet:
        return _fleet(fleet, output)
    result = measure(bag or shipped_bag(), quick, say)
    with atomic_file(output / "bench.json") as part:
        part.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if page is not None:
        with atomic_file(page) as part:
            part.write_text(as_page(result), encoding="utf-8")
    files = plots(result, output)
    print(text(result))
    print()
    for path in (output / "bench.json", *files):
        print(f"output  {path}")
    rows = [
        *result["simulate"],
        *result["figure_13"],
        *result["figure_14"]["rows"],
        *result["time_error"]["schemes"],
        result["snap"],
    ]
    return 1 if any(row["failure"] for row in rows) else 0


def _fleet(draws: int, output: Path) -> int:
    """NEES, NIS and errors of robots drawn from their tolerances, as a table and ``fleet.json``."""
    from ctr_dynamics.benchmarks.fleet import fleet, table
    from ctr_dynamics.runtime.replay import plain

    rows = fleet(draws, say=lambda line: print(f"bench: {line}", file=sys.stderr, flush=True))
    with atomic_file(output / "fleet.json") as part:
        part.write_text(json.dumps(plain(rows), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    print(table(rows))
    print(f"\noutput  {output / 'fleet.json'}")
    return 1 if any(row["failures"] for row in rows) else 0
