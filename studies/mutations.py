"""Do the tests bite? Constants and signs of model, filter and diagnosis are changed one at a time, and the tests that should notice are run.

    python -m studies.mutations --output mutations.jsonl --draws 60 --seed 1
    python -m studies.mutations --output mutations.jsonl --table

A mutation doubles a number, turns a sum into a difference or drops a minus. Places are drawn evenly over the packages, then over what they hold.
Tests that import the module run first, then those of its package's folder; the first failure ends a mutation. Each outcome is one line of the output;
a run that is stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "model": ("test/model", "test/kernels"),
    "kernels": ("test/kernels", "test/model", "test/estimation", "test/snap"),
    "estimation": ("test/estimation",),
    "sensing": ("test/sensing", "test/estimation"),
    "effects": ("test/effects", "test/model"),
    "diagnosis": ("test/diagnosis",),
}
"""Packages that are changed, with the folders of their tests."""
SHAPES = [
    "empty",
    "zeros",
    "ones",
    "full",
    "reshape",
    "range",
    "arange",
    "eye",
    "transpose",
]  # larger arrays are no error
LONG = ("test_hidden", "test_nothing_hidden", "test_bags")  # run last
LONGEST_S = 1800.0  # of the tests of one mutation


class Site(NamedTuple):
    """A place in a file: characters ``begin`` to ``end``, and what stands there afterwards."""

    path: str
    line: int
    begin: int
    end: int
    before: str
    after: str


def sites(path: Path) -> Iterator[Site]:
    """Numbers and signs of a module that a program computes with: not those of indices, messages and documentation."""
    text = path.read_text()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    raw = text.encode()
    ignored: set[int] = set()
    for node in ast.walk(tree := ast.parse(text)):
        named = getattr(node.func, "attr", getattr(node.func, "id", "")) if isinstance(node, ast.Call) else ""
        if named in SHAPES or isinstance(node, ast.Subscript | ast.JoinedStr | ast.Raise | ast.Assert):
            inside = node.slice if isinstance(node, ast.Subscript) else node
            ignored.update(id(child) for child in ast.walk(inside))

    def site(begin: int, end: int, line: int, after: str) -> Site:
        name = path.relative_to(ROOT).as_posix()
        return Site(name, line, begin, end, raw[begin:end].decode(), after)

    for node in ast.walk(tree):
        if id(node) in ignored:
            continue
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            if node.value in (0, 1) and isinstance(node.value, int):
                continue  # counts and indices
            begin = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset  # type: ignore[operator]
            yield site(begin, end, node.lineno, f"({raw[begin:end].decode()} * 2)" if node.value else "1.0")
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            if isinstance(node.left, ast.Constant | ast.List | ast.Tuple | ast.JoinedStr):
                continue
            left = starts[node.left.end_lineno - 1] + node.left.end_col_offset  # type: ignore[operator]
            right = starts[node.right.lineno - 1] + node.right.col_offset
            between, sign = raw[left:right].decode(), "+" if isinstance(node.op, ast.Add) else "-"
            if between.count(sign) == 1:
                at = left + between.index(sign)
                yield site(at, at + 1, node.lineno, "-" if sign == "+" else "+")
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            begin = starts[node.lineno - 1] + node.col_offset
            yield site(begin, begin + 1, node.lineno, "+")


def drawn(count: int, seed: int, packages: list[str]) -> list[Site]:
    """``count`` places, evenly over ``packages``, each from a module in proportion to its places."""
    rng = random.Random(seed)
    pools = {
        name: [s for path in sorted((ROOT / "ctr_dynamics" / name).rglob("*.py")) for s in sites(path)]
        for name in packages
    }
    return [rng.choice(pools[packages[k % len(packages)]]) for k in range(count)]


def tests_of(site: Site) -> list[list[str]]:
    """Test files in the order in which they run: those that import the module, then those of the package's folders."""
    module = site.path.removesuffix(".py").replace("/", ".")
    files = sorted((ROOT / "test").rglob("test_*.py"))
    texts = {p.relative_to(ROOT).as_posix(): p.read_text() for p in files}
    near = [name for name, text in texts.items() if module in text]
    folders = PACKAGES[site.path.split("/")[1]]
    far = [name for name in texts if name.startswith(folders) and name not in near]
    long = [name for name in far if Path(name).name.startswith(LONG)]
    return [group for group in (near, [p for p in far if p not in long], long) if group]


def run(site: Site, folder: Path) -> dict[str, Any]:
    """Apply a mutation in the copy ``folder`` of the project, run its tests, and take it back; ``finished``: whether they ended in time."""
    path = folder / site.path
    raw = path.read_bytes()
    path.write_bytes(raw[: site.begin] + site.after.encode() + raw[site.end :])
    caught, finished, begin = "", True, time.monotonic()
    try:
        for group in tests_of(site):
            left = max(LONGEST_S - (time.monotonic() - begin), 0.0)
            try:
                done = subprocess.run(
                    [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", *group],
                    cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, text=True, timeout=left,
                )  # fmt: skip
            except subprocess.TimeoutExpired:
                finished = False
                break
            if done.returncode:
                lines = [x for x in done.stdout.splitlines() if x.startswith(("FAILED", "ERROR"))]
                caught = lines[0] if lines else (done.stdout + done.stderr)[-200:]
                break
    finally:
        path.write_bytes(raw)
    return {
        **site._asdict(),
        "caught": caught,
        "finished": finished,
        "seconds": round(time.monotonic() - begin),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Mutations of each package that were caught, as Markdown, and the survivors."""
    lines = ["| package | mutations | caught | not finished |", "|---|---|---|---|"]
    for name in PACKAGES:
        own = [r for r in rows if r["path"].split("/")[1] == name]
        caught, open_ = sum(bool(r["caught"]) for r in own), sum(not r["finished"] for r in own)
        lines += [f"| {name} | {len(own)} | {caught} | {open_} |"] if own else []
    survived = [r for r in rows if r["finished"] and not r["caught"]]
    return "\n".join(
        [*lines, "", *(f"- {r['path']}:{r['line']} `{r['before']}` -> `{r['after']}`" for r in survived)]
    )


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--packages", nargs="+", choices=PACKAGES, default=["model", "kernels", "estimation", "diagnosis"]
    )
    parser.add_argument("--table", action="store_true", help="print the table, and run nothing")
    options = parser.parse_args()
    rows = [json.loads(x) for x in options.output.read_text().splitlines()] if options.output.exists() else []
    done = {(r["path"], r["begin"]) for r in rows}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "project"
        if not options.table:
            ignore = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache")
            shutil.copytree(ROOT, folder, ignore=ignore, symlinks=True)
        for site in [] if options.table else drawn(options.draws, options.seed, options.packages):
            if (site.path, site.begin) in done:
                continue
            row = run(site, folder)
            rows.append(row)
            done.add((site.path, site.begin))
            with options.output.open("a") as stream:
                stream.write(json.dumps(row) + "\n")
            outcome = row["caught"] or ("SURVIVED" if row["finished"] else "not finished")
            print(
                f"{site.path}:{site.line} {site.before} -> {site.after}: {outcome}, {row['seconds']} s",
                flush=True,
            )
    print(table(rows))


if __name__ == "__main__":
    main()
