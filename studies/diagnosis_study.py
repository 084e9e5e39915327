"""The large study of diagnosis: many cases with hidden effects, from a simulator of its own, and how often the verdicts are right.

    python -m studies.diagnosis_study --output study --singles 80 --clean 80 --pairs 24 --outside 24
    python -m studies.diagnosis_study --output study --table docs/study.md

Every case is one task (joblib processes, or a Dask cluster with --cluster ADDRESS). Results go to DIR/results.jsonl, one line a case; a run that
is stopped goes on where it was. Seeds are the stratum's first seed plus the number of the case.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from studies import add_truth_path

Z95 = 1.959964


def run_case(stratum: str, seed: int) -> dict[str, Any]:
    """Make a case, diagnose it, then open the answer."""
    add_truth_path()
    from truth.cases import make_case

    from ctr_dynamics.diagnosis.output.findings import findings
    from ctr_dynamics.diagnosis.pipeline import diagnose_recordings
    from ctr_dynamics.diagnosis.recording import read_recording
    from ctr_dynamics.diagnosis.run_context import RunContext
    from ctr_dynamics.robot_files import load_robot

    with tempfile.TemporaryDirectory() as folder:
        begin = time.time()
        case = make_case(seed, stratum, folder)
        made = time.time() - begin
        robot = load_robot(case.robot)
        result = diagnose_recordings(
            robot,
            [read_recording(case.protocol, robot)],
            [read_recording(case.sweep, robot)],
            context=RunContext(workers=1),
        )
        content = findings(result, "", None)
        answer = case.unseal()
        sizes = true_separations(result, answer) if result.search is not None else {}
        removable = error_removed(result, answer)
    kept = (
        "verdict",
        "causes",
        "cause_set95",
        "residual",
        "validation",
        "seconds",
        "probabilities",
        "numerics",
        "not_observable",
        "notes",
    )
    return {
        "stratum": stratum,
        "seed": seed,
        "hidden": answer["hidden"],
        "rival": answer["rival"],
        "separations": sizes,
        "removed": removable,
        "making_s": made,
        **{key: content[key] for key in kept},
    }


def true_separations(result: Any, answer: dict[str, Any]) -> dict[str, float]:
    """d_sep of every true cause, from the true effects fitted to the data, against the nearest rival; empty where no such fit comes to the noise."""
    from ctr_dynamics.diagnosis.inference.sensitivities import sensitivities_at
    from ctr_dynamics.diagnosis.inference.separation import separation
    from ctr_dynamics.diagnosis.run_context import RunContext

    problem, found = result.problem, result.search
    members, start = [], {}
    for item in answer["hidden"]:
        values = item.get("parameters", {})
        options = [
            c
            for c in found.pool
            if c.effect == item["effect"] and {q.name for q in c.quantities} & set(values)
        ]
        if not options:
            return {}
        member = next((c for c in options if {q.name for q in c.quantities} <= set(values)), options[0])
        members.append(member)
        start.update(dict(member.start))
        for q in member.quantities + member.shapes:
            if q.name in values:
                start[q.key] = q.parameter.coordinate(values[q.name]["total"])
    if not members:
        return {}
    context = RunContext(workers=1)
    best = _fit_of_truth(result, tuple(members), start)
    here = sensitivities_at(problem, best.fit.point, found.pool, context) if best else None
    if best is None or here is None:
        return {}
    own = {m.effect for m in members}
    out = {}
    for member in members:
        rivals = [c for c in here.by_candidate if c.effect not in own]
        out[member.effect] = min(separation(problem, best.fit, (member,), rival, here) for rival in rivals)
    return out


def _fit_of_truth(result: Any, members: tuple[Any, ...], start: dict[Any, float]) -> Any:
    """The hypothesis of ``members``, from their true values or as the search has found it; None where it leaves more than noise."""
    from ctr_dynamics.diagnosis.inference.candidates import causes_of, keys_of
    from ctr_dynamics.diagnosis.inference.fit_quality import is_acceptable
    from ctr_dynamics.diagnosis.inference.growing_fit import fit_growing
    from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis, fit_hypothesis, with_form

    problem = result.problem
    best = next((e for e in result.search.hypotheses if e.keys == keys_of(members)), None)
    if best is None or not is_acceptable(problem, best.fit):
        best = fit_hypothesis(problem, members, start)
    if best is None or not is_acceptable(problem, best.fit):  # out of phase by turns
        grown = fit_growing(with_form(problem, members), causes_of(members), start)
        best = None if grown is None else Hypothesis(members, grown)
    return best if best is not None and is_acceptable(problem, best.fit) else None


def error_removed(result: Any, answer: dict[str, Any]) -> float | None:
    """Fraction of the removable held-out error that the extension removes: 1 - (ext^2 - floor^2) / (rec^2 - floor^2)."""
    from ctr_dynamics.diagnosis.whitening import noise_floor

    v = result.validation
    if v is None or not answer["hidden"]:
        return None
    floor2 = noise_floor(result.robot) ** 2
    before = v.rms_recalibrated**2 - floor2
    return None if before < 0.05 * floor2 else 1.0 - (v.rms_extended**2 - floor2) / before


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a fraction."""
    if count == 0:
        return 0.0, 1.0
    p = hits / count
    centre = (p + Z95**2 / (2 * count)) / (1 + Z95**2 / count)
    half = Z95 * math.sqrt(p * (1 - p) / count + Z95**2 / (4 * count**2)) / (1 + Z95**2 / count)
    return max(0.0, centre - half), min(1.0, centre + half)


def fraction(outcomes: Iterable[bool]) -> str:
    """Hits of count, fraction and interval."""
    hits = list(outcomes)
    count, n = len(hits), sum(hits)
    if not count:
        return "no case"
    low, high = wilson(n, count)
    return f"{n} of {count} = {100 * n / count:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def hidden_effects(row: dict[str, Any]) -> list[str]:
    """Sorted IDs of what was hidden."""
    return sorted({h["effect"] for h in row["hidden"]})


def named_effects(row: dict[str, Any]) -> list[str]:
    """Sorted IDs of what was found."""
    return sorted({c["effect"] for c in row["causes"]})


def interval_hits(rows: list[dict[str, Any]], level: str) -> list[bool]:
    """Whether the intervals of rightly found causes hold the true totals."""
    from ctr_dynamics.effects import EFFECTS

    hits = []
    for row in rows:
        for item in row["hidden"]:
            for cause in row["causes"]:
                if cause["effect"] != item["effect"]:
                    continue
                for name, value in item["parameters"].items():
                    found = cause["parameters"].get(name)
                    truth = value["total"] if isinstance(value, dict) else value
                    if found is None or found.get(level) is None or not isinstance(truth, int | float):
                        continue
                    low, high = found[level]
                    period = EFFECTS[item["effect"]].find(name).period
                    if (
                        period and low is not None and high is not None
                    ):  # the same angle, nearest to the interval
                        truth += period * round((0.5 * (low + high) - truth) / period)
                    hits.append((low is None or low <= truth) and (high is None or truth <= high))
    return hits


def is_right(row: dict[str, Any]) -> bool:
    """Whether the first cause is the hidden one."""
    return bool(row["causes"]) and row["causes"][0]["effect"] == hidden_effects(row)[0]


def in_set(row: dict[str, Any]) -> bool:
    """Whether what was hidden is among the listed sets of causes."""
    return hidden_effects(row) in [sorted(s) for s in row["cause_set95"]]


def is_sure(row: dict[str, Any]) -> bool:
    """Whether something was hidden and the likeliest hypothesis has a probability of at least 0.95."""
    likeliest = row["probabilities"][0]["probability"] if row["probabilities"] else 0.0
    return bool(row["cause_set95"] and row["hidden"]) and likeliest >= 0.95


def likeliest_is_right(row: dict[str, Any]) -> bool:
    """Whether the likeliest hypothesis, or what is named, is what was hidden."""
    hidden = hidden_effects(row)
    return sorted(row["probabilities"][0]["effects"]) == hidden or named_effects(row) == hidden


def is_clear(row: dict[str, Any], count: int) -> bool:
    """Whether the separations of ``count`` hidden causes are known, none below 8."""
    sizes = row["separations"].values()
    return len(sizes) >= count and min(sizes) >= 8.0


def figures(rows: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """(figure, aim, measured)."""
    by: dict[str, list[dict[str, Any]]] = {s: [r for r in rows if r["stratum"] == s] for s in SEEDS}
    clear = [r for r in by["single"] if is_clear(r, 1)]
    clear_pairs = [r for r in by["pair"] if len(r["separations"]) == 2 and is_clear(r, 2)]
    excited = [r for r in rows if r["stratum"] != "not_excited"]
    given = [
        c["effect"] in hidden_effects(r)
        for r in excited
        for c in r["causes"]
        if (c["probability"] or 0.0) >= 0.95
    ]
    sizes = [len(r["cause_set95"]) for r in clear]
    gains = sorted(r["removed"] for r in clear if r["removed"] is not None)
    seconds = sorted(r["seconds"] for r in rows)
    median = gains[len(gains) // 2] if gains else math.nan
    return [
        ("singles with d_sep >= 8: right cause first", ">= 95 %", fraction(map(is_right, clear))),
        ("singles with d_sep >= 8: truth in the 95 % set", ">= 95 %", fraction(map(in_set, clear))),
        ("their mean size of the 95 % set", "<= 3", f"{sum(sizes) / max(len(sizes), 1):.2f}"),
        ("all singles: right cause first", "-", fraction(map(is_right, by["single"]))),
        ("clean bags named", "<= 2 %", fraction(r["verdict"] != "clean" for r in by["none"])),
        (
            "90 % intervals that hold the truth",
            "84-96 %",
            fraction(interval_hits(clear + clear_pairs, "ci90")),
        ),
        ("99 % intervals that hold the truth", "-", fraction(interval_hits(clear + clear_pairs, "ci99"))),
        (
            "removable held-out error removed (median)",
            ">= 85 %",
            f"{100 * median:.0f} % of {len(gains)} cases",
        ),
        (
            "pairs with both d_sep >= 8 exactly right",
            ">= 80 %",
            fraction(named_effects(r) == hidden_effects(r) for r in clear_pairs),
        ),
        (
            "outside the catalogue called unknown",
            ">= 90 %",
            fraction(r["verdict"] == "unknown" or "unknown" in named_effects(r) for r in by["outside"]),
        ),
        ("causes of probability >= 0.95 that are right", ">= 93 %", fraction(given)),
        (
            "something hidden: likeliest hypothesis right where it has >= 0.95",
            "-",
            fraction(likeliest_is_right(r) for r in excited if is_sure(r)),
        ),
        ("not excited called so", "-", fraction(r["verdict"] == "not_excited" for r in by["not_excited"])),
        ("near ties: truth in the 95 % set", "-", fraction(map(in_set, by["near_tie"]))),
        (
            "time of a diagnosis on one core (median, largest)",
            "-",
            f"{seconds[len(seconds) // 2]:.0f} s, {seconds[-1]:.0f} s" if seconds else "-",
        ),
    ]


def markdown(rows: list[dict[str, Any]], seeds: dict[str, int], run_s: float | None) -> str:
    """The table as Markdown."""
    lines = ["| figure | aim | measured, Wilson 95 % interval |", "|---|---|---|"]
    lines += [f"| {a} | {b} | {c} |" for a, b, c in figures(rows)]
    counts = {s: sum(r["stratum"] == s for r in rows) for s in seeds}
    lines.append("")
    lines.append(
        "Cases (first seed): " + ", ".join(f"{s} {counts[s]} ({seeds[s]})" for s in seeds if counts[s]) + "."
    )
    total = sum(r["seconds"] + r["making_s"] for r in rows)
    lines.append(
        f"Work: {total / 3600:.2f} core hours"
        + (f", {run_s / 60:.0f} min in the last run." if run_s else ".")
    )
    return "\n".join(lines) + "\n"


SEEDS = {
    "none": 50_000,
    "single": 51_000,
    "pair": 52_000,
    "outside": 53_000,
    "not_excited": 54_000,
    "near_tie": 55_000,
}


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--clean", type=int, default=80)
    parser.add_argument("--singles", type=int, default=80)
    parser.add_argument("--pairs", type=int, default=24)
    parser.add_argument("--outside", type=int, default=24)
    parser.add_argument("--not-excited", type=int, default=8)
    parser.add_argument("--near-ties", type=int, default=8)
    parser.add_argument(
        "--offset", type=int, default=0, help="added to every seed: other cases than the published ones"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--cluster", default="", help="address of a Dask scheduler")
    parser.add_argument("--table", type=Path, help="write the table here, and run nothing")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "results.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    seeds = {s: first + options.offset for s, first in SEEDS.items()}
    begin = time.time()
    if options.table is None:
        counts = {
            "none": options.clean, "single": options.singles, "pair": options.pairs, "outside": options.outside,
            "not_excited": options.not_excited, "near_tie": options.near_ties,
        }  # fmt: skip
        done = {(r["stratum"], r["seed"]) for r in rows}
        # strata take turns, so that a study that is stopped early has some of each
        todo = sorted(
            (k / max(counts[s], 1), s, seeds[s] + k)
            for s in counts
            for k in range(counts[s])
            if (s, seeds[s] + k) not in done
        )
        with path.open("a") as stream:
            for row in _work([(s, seed) for _, s, seed in todo], options):
                rows.append(row)
                stream.write(json.dumps(row) + "\n")
                stream.flush()
                outcome = (
                    f"{hidden_effects(row)} -> {row['verdict']} {named_effects(row)} {row.get('error', '')}"
                )
                print(f"{len(rows)}: {row['stratum']} {row['seed']}: {outcome}", flush=True)
    rows = [r for r in rows if "error" not in r]
    text = markdown(rows, seeds, time.time() - begin if options.table is None else None)
    print(text)
    if options.table is not None:
        options.table.write_text(text)


def run_guarded(stratum: str, seed: int) -> dict[str, Any]:
    """A case that cannot be made or diagnosed is said, not lost."""
    try:
        return run_case(stratum, seed)
    except Exception as error:
        return {
            "stratum": stratum,
            "seed": seed,
            "hidden": [],
            "causes": [],
            "verdict": "error",
            "error": f"{type(error).__name__}: {error}",
        }


def _work(todo: list[tuple[str, int]], options: argparse.Namespace) -> Any:
    if options.cluster:
        from dask.distributed import Client, as_completed

        with Client(options.cluster) as client:
            for future in as_completed([client.submit(run_guarded, s, seed) for s, seed in todo]):
                yield future.result()
        return
    from joblib import Parallel, delayed

    yield from Parallel(options.workers, return_as="generator_unordered", batch_size=1)(
        delayed(run_guarded)(s, seed) for s, seed in todo
    )


if __name__ == "__main__":
    main()
