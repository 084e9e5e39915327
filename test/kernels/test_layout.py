"""One declaration of every row: compiled or not, for any number of tubes, and nowhere else."""

import io
import re
import tokenize
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from ctr_dynamics.kernels import layout
from ctr_dynamics.kernels.layout import (
    BASE_ENDS,
    FIELDS,
    INPUTS,
    PARAMETERS,
    RESIDUAL,
    STATE,
    UNKNOWNS,
    WORKSPACE,
    base_end_rows,
    base_field_count,
    field_rows,
    input_row,
    input_rows,
    parameter_rows,
    parameters_of_inputs,
    residual_rows,
    state_rows,
    unknown_rows,
    workspace_rows,
)

PACKAGE = Path(layout.__file__).parents[1]
BLOCKS = {
    state_rows: STATE,
    field_rows: FIELDS,
    base_end_rows: BASE_ENDS,
    unknown_rows: UNKNOWNS,
    residual_rows: RESIDUAL,
    parameter_rows: PARAMETERS,
    input_rows: INPUTS,
    workspace_rows: WORKSPACE,
}


def compiled(rows, names):
    """The first rows of ``names`` as compiled code sees them, for a number of tubes."""
    text = "def first(n):\n    r = rows(n)\n    return (" + "".join(f"r.{name}, " for name in names) + ")\n"
    found = {"rows": rows}
    exec(text, found)
    return njit(found["first"])


@pytest.mark.parametrize("rows", BLOCKS, ids=lambda rows: rows.__name__)
def test_compiled_rows_are_those_of_python(rows):
    names = [*(group.name for group in BLOCKS[rows]), "size"]
    first = compiled(rows, names)
    for n in (1, 2, 3, 4):
        assert first(n) == tuple(getattr(rows(n), name) for name in names)


@pytest.mark.parametrize("rows", BLOCKS, ids=lambda rows: rows.__name__)
def test_groups_follow_each_other_without_gaps(rows):
    for n in (1, 2, 3, 4):
        block = rows(n)
        each = np.concatenate([block.rows(name) for name in block.names])
        assert np.array_equal(each, np.arange(block.size))


def test_a_group_that_is_not_there_is_an_error():
    with pytest.raises(AttributeError, match="no_such"):
        _ = parameter_rows(2).no_such
    with pytest.raises(KeyError, match="no_such"):
        parameter_rows(2).pack(no_such=1.0)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_what_the_kernels_take_for_granted_of_the_order(n):
    """Side by side: inputs of a stage in their block and in the parameters, the parameters in the workspace, force and moment of a state."""
    assert [input_row(n, i) for i in range(input_rows(n).size)] == parameters_of_inputs(n).tolist()
    parameters, workspace = parameter_rows(n), workspace_rows(n)
    first = workspace.bending_stiffness - parameters.bending_stiffness
    assert all(getattr(workspace, name) - getattr(parameters, name) == first for name in parameters.names)
    for rows in (state_rows(n), unknown_rows(n), residual_rows(n)):
        assert rows.moment_xy == rows.force + 3
    assert field_rows(n).curvature_z == field_rows(n).curvature_xy + 2
    assert unknown_rows(n).size == residual_rows(n).size


def test_base_fields_are_two_a_point_and_what_stands_at_the_ends():
    assert base_field_count(3, 4) == base_field_count.py_func(3, 4) == 3 * (4 * 4 + 1) * 2 + 4 * 3 + 3


def literals(text):
    """Sums in ``text`` that place a row by hand: a number of two digits times n, or n times and a number beside it."""
    code = " ".join(
        token.string
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in (tokenize.COMMENT, tokenize.STRING)
    )
    return re.findall(r"\b\d\d+ \* n\b|\b\d+ \+ \d+ \* n\b|\b[1-9]\d* \* n \+ \d+\b", code)


def test_rows_placed_by_hand_are_found():
    assert literals("a = par[14 * n + 9]; b = 16 + 3 * n  # 20 * n + 33") == ["14 * n", "16 + 3 * n"]
    assert literals('x = W[T + 7 * i]; "14 * n + 9"') == []


@pytest.mark.parametrize("folder", ["kernels", "model", "snap"])
def test_no_row_is_placed_by_hand(folder):
    found = {path.name: literals(path.read_text()) for path in (PACKAGE / folder).glob("*.py")}
    assert {name: rows for name, rows in found.items() if rows} == {}
