"""The cache of compiled kernels: what is compiled again, what is not, and what is said where it cannot be kept.

Each test runs a small package of the same name, with this package's compiler in it, in processes of their own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import FunctionType

import pytest

from ctr_dynamics.kernels import callees, compiler, rotations

FILES = {
    "__init__.py": "",
    "kernels/__init__.py": "",
    "kernels/inner.py": """
from ctr_dynamics.kernels.compiler import njit
@njit()
def inner(x):
    return x + 1.0
""",
    "kernels/outer.py": """
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels import inner as below
add = below.inner
@njit()
def outer(x):
    return 10.0 * add(x)
@njit()
def first(pair):
    return pair.a
@njit()
def apply(function, x):
    return function(x)
""",
    "pairs.py": """
from typing import NamedTuple
class Pair(NamedTuple):
    a: float
    b: float
""",
    "functions.py": """
from ctr_dynamics.kernels.compiler import njit
@njit()
def chosen(x):
    return x - 1.0
""",
    "health.py": """
from ctr_dynamics.kernels import inner, outer
from ctr_dynamics.functions import chosen
from ctr_dynamics.pairs import Pair
print(outer.outer(1.0), outer.first(Pair(3.0, 4.0)), outer.apply(chosen, 1.0))
for kernel in (outer.outer, outer.first, outer.apply):
    print(kernel.py_func.__name__, 'loaded' if sum(kernel.stats.cache_hits.values()) else 'compiled')
""",
}


class Checkout:
    """A small package in a folder of its own."""

    def __init__(self, folder: Path, cache: Path) -> None:
        self.package, self.cache = folder / "ctr_dynamics", cache
        for name, text in FILES.items():
            (self.package / name).parent.mkdir(parents=True, exist_ok=True)
            (self.package / name).write_text(text)
        for module in (compiler, callees):
            shutil.copy(module.__file__, self.package / "kernels")

    def replace(self, name: str, old: str, new: str) -> None:
        text = (self.package / name).read_text()
        assert old in text
        (self.package / name).write_text(text.replace(old, new))

    def run(self) -> tuple[list[float], dict[str, str], str]:
        """The results, whether each kernel was loaded or compiled, and what was said on standard error."""
        environment = {
            **os.environ,
            "PYTHONPATH": str(self.package.parent),
            "NUMBA_CACHE_DIR": str(self.cache),
            "PYTHONDONTWRITEBYTECODE": "1",  # two changes within a second and of one size are the same to Python's own cache
        }
        command = [sys.executable, "-m", "ctr_dynamics.health"]
        done = subprocess.run(
            command, cwd=self.package.parent, env=environment, capture_output=True, text=True, check=True
        )
        first, *lines = done.stdout.splitlines()
        return [float(x) for x in first.split()], dict(line.split() for line in lines), done.stderr


@pytest.fixture
def checkout(tmp_path):
    made = Checkout(tmp_path / "one", tmp_path / "cache")
    results, state, said = made.run()
    assert results == [20.0, 3.0, 0.0]
    assert set(state.values()) == {"compiled"}
    assert said == ""
    return made


LOADED = {"outer": "loaded", "first": "loaded", "apply": "loaded"}


def test_a_second_start_and_a_second_checkout_compile_nothing(checkout, tmp_path):
    assert checkout.run()[1] == LOADED
    assert Checkout(tmp_path / "two", checkout.cache).run()[1] == LOADED


def test_machine_code_is_kept_of_what_python_calls_alone(checkout):
    assert {folder.name.split("-")[0] for folder in checkout.cache.iterdir()} == {
        "ctr_dynamics.kernels.outer"
    }


def test_a_change_elsewhere_compiles_nothing(checkout):
    checkout.replace("health.py", "print(outer", "# a comment\nprint(outer")
    os.utime(checkout.package / "kernels" / "outer.py")
    assert checkout.run()[1] == LOADED


def test_a_change_of_a_kernel_compiles_what_calls_it(checkout):
    checkout.replace("kernels/inner.py", "1.0", "2.0")
    results, state, _ = checkout.run()
    assert results[0] == 30.0
    assert state["outer"] == "compiled"


def test_arguments_are_known_by_their_fields_and_their_source(checkout):
    checkout.replace("pairs.py", "a: float\n    b: float", "b: float\n    a: float")
    checkout.replace("functions.py", "- 1.0", "- 2.0")
    results, state, _ = checkout.run()
    assert results == [20.0, 4.0, -1.0]
    assert state == {"outer": "loaded", "first": "compiled", "apply": "compiled"}


def test_a_class_that_has_moved_hides_nothing(checkout):
    """One checkout has moved the class of an argument: both go on with one cache."""
    moved = Checkout(checkout.cache.parent / "two", checkout.cache)
    (moved.package / "pairs.py").rename(moved.package / "moved.py")
    moved.replace("health.py", "pairs", "moved")
    assert moved.run()[1] == {**LOADED, "first": "compiled"}
    assert checkout.run()[1] == LOADED
    assert moved.run()[1] == LOADED


def test_damaged_files_are_compiled_again(checkout):
    for file in checkout.cache.rglob("*.nbc"):
        file.write_bytes(file.read_bytes()[:100])
    assert set(checkout.run()[1].values()) == {"compiled"}
    assert checkout.run()[1] == LOADED


def test_caches_that_nobody_uses_go(checkout):
    folders = {folder.name for folder in checkout.cache.iterdir()}
    mine = checkout.cache / "ctr_dynamics.kernels.gone-0123456789abcdef"
    others = checkout.cache / "of_another_package"
    old = time.time() - (compiler.KEPT_DAYS + 1) * 86400
    for folder in (mine, others, *checkout.cache.iterdir()):
        folder.mkdir(exist_ok=True)
        os.utime(folder, (old, old))
    assert checkout.run()[1] == LOADED  # dates what it uses
    checkout.replace("kernels/inner.py", "1.0", "3.0")  # something new: time to look for what is old
    checkout.run()
    left = {folder.name for folder in checkout.cache.iterdir()}
    assert mine.name not in left
    assert others.name in left
    assert {name for name in folders if ".outer-" in name} <= left


def test_a_folder_that_cannot_be_written_is_said_once(tmp_path):
    (tmp_path / "file").write_text("")
    results, state, said = Checkout(tmp_path / "one", tmp_path / "file" / "cache").run()
    assert results == [20.0, 3.0, 0.0]
    assert set(state.values()) == {"compiled"}
    assert said.count("cannot be kept") == 1
    assert "set NUMBA_CACHE_DIR" in said


def test_a_function_that_its_module_does_not_explain_is_not_cached():
    """Its file, name and types are those of the original: the cache would take one for the other."""
    original = rotations.multiply
    changed = FunctionType(original.__code__, {**vars(rotations), "np": None})
    with pytest.raises(TypeError, match="cache=False"):
        compiler.njit()(changed)
    compiler.njit(cache=False)(changed)
    factor = 2.0
    with pytest.raises(TypeError, match="cache=False"):
        compiler.njit()(lambda x: factor * x)
