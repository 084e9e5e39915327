"""Readers take damaged files or refuse them in one line: some hundred of the files of studies/fuzz_readers.py, and its own account."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies import fuzz_readers as fuzz

ROOT = Path(__file__).parents[2]


def test_whole_files_are_taken(tmp_path):
    for kind, (files, suffix, reader) in fuzz.seeds().items():
        for number, data in enumerate(files):
            path = tmp_path / f"{kind}{number}{suffix}"
            path.write_bytes(data)
            reader(path)


def test_damaged_files_neither_crash_nor_hang():
    figures = fuzz.fuzz(400, seed=20)
    assert figures["failures"] == []
    assert sum(sum(found.values()) for found in figures["counts"].values()) == 400
    assert set(figures["counts"]) == set(fuzz.SHARE)
    taken = sum(found.get("taken", 0) for found in figures["counts"].values())
    assert 50 < taken < 350  # the damage is neither nothing nor everything


def test_failures_are_counted(tmp_path):
    """What the account is for: a reader that breaks, hangs or takes too much is seen."""

    def hang(path):
        while True:
            pass

    def refuse(path):
        raise fuzz.InputError("two\nlines")  # made into one by InputError itself

    fuzz.signal.signal(fuzz.signal.SIGALRM, fuzz._alarm)
    fuzz.LIMIT_S, before = 0.2, fuzz.LIMIT_S
    try:
        outcomes = {}
        for name, reader in {
            "hang": hang,
            "refuse": refuse,
            "break": lambda path: 1 / 0,
            "take": lambda path: None,
        }.items():
            kinds = dict.fromkeys(fuzz.SHARE, ([b"x" * 50], ".x", reader))
            outcomes[name] = fuzz.read_one(0, 1, kinds, tmp_path)[1]
    finally:
        fuzz.LIMIT_S = before
    assert outcomes == {"hang": "too long", "refuse": "rejected", "break": "failed", "take": "taken"}


def test_nothing_in_a_file_is_executed(tmp_path):
    from ctr_dynamics.csv_import.column_layout import read_layout
    from ctr_dynamics.errors import InputError
    from ctr_dynamics.parameters import read_parameter_file
    from ctr_dynamics.robot_files import load_robot

    mark = tmp_path / "executed"
    path = tmp_path / "file.yaml"
    path.write_text(f"a: !!python/object/apply:os.system ['touch {mark}']\n")
    for reader in (load_robot, read_parameter_file, read_layout):
        with pytest.raises(InputError, match="could not determine a constructor"):
            reader(path)
    assert not mark.exists()


def test_package_never_unpickles_or_evaluates():
    forbidden = (
        "pickle",
        "eval(",
        "exec(",
        "yaml.load(text)",
        "yaml.unsafe",
        "shell=True",
        "allow_pickle=True",
        "os.system",
    )
    for file in (ROOT / "ctr_dynamics").rglob("*.py"):
        text = file.read_text()
        for word in forbidden:
            hits = [
                line
                for line in text.replace("allow_pickle=False", "").splitlines()
                if word in line and "_eval(" not in line and "str_eval" not in line
            ]
            assert not hits, (file, hits)
