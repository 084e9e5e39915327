"""The shape of the source: names of files, lengths, arguments, and where compiled functions live."""

from __future__ import annotations

import ast
import inspect
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tools.reference import arguments, public

ROOT = Path(__file__).parents[1]
FOLDERS = ("ctr_dynamics", "tools", "studies", "test", "examples", "launch")
MOST_LINES = 500
MOST_ARGUMENTS, MOST_PUBLIC = 10, 8
# Files that are longer: this list only gets shorter.
LONG = {"test/diagnosis/truth/kernels.py"}
# File names that come twice: likewise.
TWICE: set[str] = set()
# Compiled functions outside of kernels/: a variant for one figure of the bench, and the tests' own simulators.
COMPILED = {"ctr_dynamics/benchmarks/euler.py", "test/diagnosis/truth/kernels.py"}


@cache
def sources() -> tuple[Path, ...]:
    return tuple(sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")))


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    """Place and definition of every function that is not compiled."""

    def inside(node: ast.AST, place: str) -> Iterator[tuple[str, ast.FunctionDef]]:
        for child in ast.iter_child_nodes(node):
            here = f"{place}: {child.name}" if isinstance(child, (ast.FunctionDef, ast.ClassDef)) else place
            if isinstance(child, ast.FunctionDef):
                yield here, child
            yield from inside(child, here)

    for path in sources():
        if "kernels" not in path.parts and relative(path) not in COMPILED:
            yield from inside(tree(path), relative(path))


def count(definition: ast.FunctionDef) -> int:
    """Arguments that a caller may give."""
    given = definition.args
    names = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    bound = bool(names) and names[0].arg in ("self", "cls")
    return len(names) - bound + (given.vararg is not None) + (given.kwarg is not None)


def test_no_function_takes_more_arguments_than_a_reader_can_hold():
    many = {
        place: count(definition) for place, definition in functions() if count(definition) > MOST_ARGUMENTS
    }
    assert many == {}
    documented = {name: arguments(thing) for name, thing in public() if inspect.isfunction(thing)}
    assert {name: found for name, found in documented.items() if len(found) > MOST_PUBLIC} == {}


def test_no_two_modules_share_a_file_name():
    places = defaultdict(list)
    for path in sources():
        if path.name not in ("__init__.py", "__main__.py", "conftest.py"):
            places[path.name].append(relative(path))
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert set(twice) == TWICE, twice


def test_no_file_is_longer_than_a_sitting():
    lengths = {relative(path): len(path.read_text(encoding="utf-8").splitlines()) for path in sources()}
    assert {name for name, length in lengths.items() if length > MOST_LINES} == LONG


def test_compiled_functions_live_in_kernels():
    found = {
        relative(path)
        for path in sources()
        if "kernels" not in path.relative_to(ROOT).parts[:2] and "njit" in path.read_text(encoding="utf-8")
    }
    elsewhere = {name for name in found if not name.startswith("test/") or name in COMPILED}
    assert elsewhere == COMPILED


@pytest.mark.parametrize("folder", ["kernels"])
def test_kernels_import_kernels_alone(folder):
    """So that a change elsewhere compiles nothing again."""
    for path in (ROOT / "ctr_dynamics" / folder).glob("*.py"):
        for node in ast.walk(tree(path)):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for module in modules:
                assert not module.startswith("ctr_dynamics") or module.startswith("ctr_dynamics.kernels"), (
                    path
                )
