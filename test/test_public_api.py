"""The public face: what `import ctr_dynamics` offers, what it costs, and that every example in a docstring is true."""

from __future__ import annotations

import doctest
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ctr_dynamics

SLOW = {"diagnose", "replay"}


def run(code: str) -> str:
    """Output of a Python process of its own."""
    return subprocess.check_output([sys.executable, "-c", code], text=True)


def test_the_public_names_are_a_dozen_and_all_there():
    assert 10 <= len(ctr_dynamics.__all__) <= 15
    assert ctr_dynamics.__all__ == sorted(ctr_dynamics.__all__)
    assert dir(ctr_dynamics) == sorted([*ctr_dynamics.__all__, "__version__"])
    for name in ctr_dynamics.__all__:
        assert getattr(ctr_dynamics, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = ctr_dynamics.nothing


def test_importing_the_package_is_cheap_and_changes_nothing():
    code = """
import gc, os, signal, sys, threading, warnings
import joblib, numba, numpy, scipy.sparse, scipy.special  # which set things of their own
def state():
    return (
        dict(os.environ), os.getcwd(), sys.path[:], sys.getswitchinterval(), sys.getrecursionlimit(), gc.get_threshold(), gc.isenabled(),
        threading.active_count(), warnings.filters[:], [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)],
        numpy.geterr(), numpy.get_printoptions(), {n: getattr(numba.config, n) for n in dir(numba.config) if n.isupper()},
    )
before = state()
import ctr_dynamics
assert state() == before
from ctr_dynamics import *
assert state() == before
"""
    assert run(code) == ""
    heavy = "import ctr_dynamics, sys; print([m for m in ('numpy', 'numba', 'scipy', 'pydantic', 'rclpy') if m in sys.modules])"
    assert run(heavy).strip() == "[]"


EXAMPLES = [
    pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in ctr_dynamics.__all__
]


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_of_a_public_name_is_true(name):
    thing = getattr(ctr_dynamics, name)
    parts = doctest.DocTestFinder(recurse=False).find(thing, name, globs={})
    assert sum(len(part.examples) for part in parts) >= 2, f"{name} has no example"
    runner = doctest.DocTestRunner(optionflags=doctest.REPORT_NDIFF)
    for part in parts:
        runner.run(part)
    assert runner.summarize(verbose=False).failed == 0


def test_public_arguments_are_few_and_documented():
    for name in ctr_dynamics.__all__:
        thing = getattr(ctr_dynamics, name)
        arguments = [a for a in inspect.signature(thing).parameters if a != "self"]
        assert len(arguments) <= 8, name
        text = inspect.getdoc(thing) or ""
        assert all(argument in text for argument in arguments), (name, arguments)


def test_type_checkers_see_the_same_names():
    stub = (Path(ctr_dynamics.__file__).parent / "__init__.pyi").read_text()
    named = re.findall(r"^from (\S+) import (\w+) as \2$", stub, re.MULTILINE)
    assert {name: module for module, name in named} == ctr_dynamics._PUBLIC
