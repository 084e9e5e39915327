"""The vocabulary of the project: one standard term for one thing, and the words that it replaces.

`python -m tools.words` lists every place that uses a replaced word, in names of the code, in its texts and in the documentation; the exit
code is 1 when there is one. docs/glossary.md presents the table.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tools.prose import pages, paragraphs

CODE = ("ctr_dynamics", "tools", "examples", "studies")
OWN = ("tools/words.py", "docs/glossary.md")  # they name the replaced words


@dataclass(frozen=True)
class Term:
    """One standard term.

    Attributes:
        term: the word to use.
        meaning: what it is here.
        not_: the words that it replaces, for readers.
        names: pattern of the parts of a name that are not used: "probes?" finds `Probe`, `far_probes` and a module `probe`.
        prose: pattern of the words in texts that are not used, without regard to case.
        where: pattern of the paths that `names` holds for.
        pages: pattern of the paths that `prose` holds for.
    """

    term: str
    meaning: str
    not_: str
    names: str = ""
    prose: str = ""
    where: str = ""
    pages: str = ""


@dataclass(frozen=True)
class Use:
    """A replaced word in use.

    Attributes:
        path: file, relative to the source tree.
        word: the name, or the words of a text.
        term: what to write instead.
    """

    path: str
    word: str
    term: str


TERMS = (
    Term(
        "acceptable fit",
        "hypothesis whose residuals pass the tests of size and whiteness",
        "adequate",
        "adequate",
        "adequate",
    ),
    Term(
        "alternative",
        "effect that the data cannot separate from the one that is named",
        "stand-in",
        "stand_ins?",
        "stand-ins?",
    ),
    Term(
        "backlash",
        "dead zone of a gear between encoder and tube; between tubes it is clearance",
        "play",
        "play",
        "play of gears?",
        "kernels/|effects/|sensing/",
    ),
    Term(
        "batched shooting",
        "shooting problems solved in the lanes of the same sweeps",
        "lockstep",
        "lockstep",
        "lockstep",
    ),
    Term(
        "checkpoint",
        "stored state of the estimator, to which late inputs return",
        "kept state",
        "kept",
        "kept states?",
        "estimation/(?:runs|estimator|out_of_sequence|checkpoint)",
    ),
    Term(
        "consistency monitor",
        "compares the innovations with what the filter expects; status `misfit`, parameters `misfit.*`",
        "misfit monitor",
        "misfit",
        "misfit",
        "estimation/|studies/",
        r"README|docs/(?!.*diagnosis)|parameters|topics",
    ),
    Term(
        "contact plane",
        "plane that the tip runs into",
        "wall",
        "(?:no_)?walls?(?!_s$|_ns$|_clock)",
        "walls?(?![ -](?:clock|time))",
        "diagnosis/|effects/|kernels/|model/",
        r"diagnosis|effects|docs/|\.md$",
    ),
    Term("covariance factor", "matrix V whose columns span the errors: covariance = V cov(a) V^T", "columns"),
    Term("decay", "exponential return to zero", "fade", "fad(?:es?(?!_s$)|ed|ing)", "fad(?:es?|ed|ing)"),
    Term("extended physics", "kernels with the effects of `extensions`", "extended"),
    Term(
        "finite-difference column",
        "copy of a simulation with one unknown perturbed",
        "probe",
        "probes?",
        "(?<!tracked )probes?",
    ),
    Term(
        "hypothesis",
        "set of effects that may be the cause; the hypothesis search compares them",
        "explanation, exploration",
        "explanations?|explorations?|explore",
        "explanations?|explorations?",
    ),
    Term(
        "idle work",
        "work done between steps, while nothing is due",
        "pause",
        "pauses?",
        "in (?:the |a )?pauses?",
        "estimation/|runtime/|ros/",
    ),
    Term(
        "inflation",
        "increase of a covariance",
        "widening",
        "widen(?:s|ed|ing)?",
        "widen(?:s|ed|ing)?",
        "estimation/|diagnosis/",
    ),
    Term("input validation", "check of a message before it is used", "intake", "intakes?", "intakes?"),
    Term("interpolation", "values between stamps", "signals"),
    Term(
        "measurement",
        "tracker pose with its stamp",
        "sample, reading",
        "samples?|readings?",
        "(?:tracker|late|out-of-order) (?:samples?|readings?)|(?:the|a|each|every) samples? (?:is|are) (?:fused|rejected)",
        "estimation/|sensing/|ros/",
    ),
    Term(
        "mesh interpolation",
        "carries fields and covariance factor from one mesh to another",
        "transfer",
        "transfers?",
        "",
        "model/|estimation/filter/",
    ),
    Term("off nominal", "away from the values of the robot file", "strayed", "strayed", "strayed"),
    Term(
        "open loop",
        "model driven by the actuators only, without corrections",
        "model alone",
        "alone",
        "model alone",
        "estimation/|reporting/|runtime/|cli/|paired",
    ),
    Term(
        "outside the gate",
        "normalised innovation squared above the gate's limit",
        "beyond the gate",
        "beyond",
        "beyond (?:the|its|ten|one) gates?",
        "estimation/",
    ),
    Term("pair ranking", "order of all pairs of causes by their probability", "sets"),
    Term(
        "paired steps",
        "fused and open-loop run, advanced in the same sweeps",
        "pair",
        "pair",
        "",
        "model/paired",
    ),
    Term(
        "poor fit", "hypothesis whose residuals are far above the noise", "hopeless", "hopeless", "hopeless"
    ),
    Term(
        "process noise",
        "randomness that the filter gives to the tip force and to the tracker's drift",
        "drive",
        "drive",
        "drive of the (?:tip )?force|driven (?:weakly|strongly|hard)|(?:strong|weak) drive",
        "estimation/|kernels/filter",
    ),
    Term("reinitialise", "start again from the static equilibrium", "begin anew", "anew", "anew"),
    Term(
        "reject",
        "leave out an input or a measurement, and say why",
        "refuse",
        "refus(?:e|es|ed|al|als)",
        "refus(?:e|es|ed|al|als)",
    ),
    Term(
        "residual",
        "remainder of an equation or a fit; of the shooting, at the tip",
        "imbalance",
        "imbalances?",
        "imbalances?",
    ),
    Term(
        "sensitivity",
        "derivative of the tip by the size of an effect",
        "signature",
        "signatures?",
        "signatures?",
        "diagnosis/|estimation/|effects/",
        "diagnosis|estimation|effects|docs/",
    ),
    Term(
        "SIMD batch, lane",
        "simulations that one vector instruction advances together",
        "pack",
        "packs?",
        "packs? of (?:lanes|eight)",
        "kernels/(?!layout)|model/",
    ),
    Term(
        "slope discontinuity",
        "time at which the derivative of an input jumps",
        "bend, kink",
        "bends?|kinks?",
        "kinks?|loads? bends?",
    ),
    Term("subscribe", "receive a topic", "hear", "", "hears"),
    Term("time of divergence", "time at which measurement and model part", "parting", "partings?", "parting"),
    Term("trajectory, motion window", "stretch of motion", "course", "courses?", "(?<!of )courses?"),
    Term(
        "variance fraction",
        "part of a variance",
        "share",
        "shares?",
        "shares? of the variance",
        "estimation/|diagnosis/",
    ),
    Term(
        "warm-up",
        "compiles and runs the kernels before the first step",
        "rehearsal",
        "rehears(?:e|es|ed|al|ing)",
        r"rehears\w+",
    ),
)


def names(tree: ast.AST) -> Iterator[str]:
    """Every name that a module defines: functions, classes, arguments, variables and attributes."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def snake(name: str) -> str:
    """A name as words in lower case with underscores between them."""
    return "_".join(re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)).lower()


def texts(tree: ast.AST) -> Iterator[str]:
    """Messages and docstrings of a module: its string constants of more than one word."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip():
            yield re.sub(r"`[^`]*`|:\w+:", " ", node.value)


def _in_names(path: str, found: set[str]) -> Iterator[Use]:
    for term in TERMS:
        if term.names and re.search(term.where, path):
            pattern = re.compile(rf"(?:^|_)(?:{term.names})(?:_|$)")
            yield from (Use(path, name, term.term) for name in sorted(found) if pattern.search(snake(name)))


def _in_prose(path: str, text: str) -> Iterator[Use]:
    for term in TERMS:
        if term.prose and re.search(term.pages, path):
            found = {match[0].lower() for match in re.finditer(rf"\b(?:{term.prose})\b", text, re.IGNORECASE)}
            yield from (Use(path, word, term.term) for word in sorted(found))


def uses(root: Path) -> list[Use]:
    """Every replaced word in use below `root`: names and texts of the code, then prose of the pages."""
    found: list[Use] = []
    for file in sorted(file for folder in CODE for file in (root / folder).rglob("*.py")):
        path = file.relative_to(root).as_posix()
        if path not in OWN:
            tree = ast.parse(file.read_text(encoding="utf-8"))
            stem = file.parent.name if file.stem == "__init__" else file.stem
            found += _in_names(path, {stem, *(name for name in names(tree) if not name.startswith("__"))})
            found += _in_prose(path, "\n".join(texts(tree)))
    for file in pages(root):
        path = file.relative_to(root).as_posix()
        if path not in OWN:
            plain = "\n".join(
                re.sub(r"`[^`]*`", " ", text) for text, _ in paragraphs(file.read_text(encoding="utf-8"))
            )
            found += _in_prose(path, plain)
    return found


def table() -> str:
    """The vocabulary as a Markdown table."""
    rows = [f"| {t.term} | {t.meaning} | {t.not_} |" for t in sorted(TERMS, key=lambda t: t.term.lower())]
    return "\n".join(["| term | what it is | instead of |", "| --- | --- | --- |", *rows])


def main(argv: list[str] | None = None) -> int:
    """List the replaced words in use; 1 when there is one."""
    parser = argparse.ArgumentParser(prog="python -m tools.words", description=__doc__)
    parser.add_argument("--root", type=Path, default=Path(), help="the source tree")
    found = uses(parser.parse_args(argv).root)
    for use in found:
        print(f"{use.path}: '{use.word}', write {use.term}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
