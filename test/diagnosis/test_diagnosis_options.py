"""Options of the diagnosis: each has a unit and a reason, is used, and acts."""

from pathlib import Path

import pytest

import ctr_dynamics.diagnosis
from ctr_dynamics.diagnosis.diagnosis_options import groups, rows

CODE = "\n".join(
    path.read_text(encoding="utf-8")
    for path in sorted(Path(ctr_dynamics.diagnosis.__file__).parent.rglob("*.py"))
    if path.name != "diagnosis_options.py"
)


@pytest.mark.parametrize(("group", "options"), list(groups()))
def test_every_option_has_unit_and_reason_and_is_used(group, options):
    found = list(rows(options))
    assert found
    for name, value, unit, reason in found:
        assert unit, name
        assert len(reason.split()) > 1, name
        assert f".{name}" in CODE or name == "fine_nodes", f"{group}.{name} = {value} is not used"
