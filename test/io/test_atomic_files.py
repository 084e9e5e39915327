"""Files that are written: whole or not at all, links and devices stay what they are, and what cannot be is said before the work."""

import os
import threading

import pytest

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file, check_targets, replaced_files


def put(path, text="new"):
    with atomic_file(path) as part:
        part.write_text(text)


@pytest.mark.parametrize(("name", "text"), [("no/such/out.mcap", "does not exist"), (".", "is a folder")])
def test_targets_that_cannot_be_written(tmp_path, name, text):
    with pytest.raises(InputError, match=text), atomic_file(tmp_path / name):
        pass
    with pytest.raises(InputError, match=f"report '.*{text}"):
        check_targets({"report": tmp_path / name}, {})
    assert list(tmp_path.iterdir()) == []


def test_no_output_is_a_file_that_is_read(tmp_path):
    table, other = tmp_path / "a.csv", tmp_path / "b.csv"
    check_targets(
        {"output": other, "summary": None}, {"table": table, "robot file": "till2020_tissue", "none": None}
    )
    with pytest.raises(InputError, match="output is the table that is read"):
        check_targets({"output": tmp_path / "." / "a.csv"}, {"table": table})
    with pytest.raises(InputError, match="summary is the same file as the output"):
        check_targets({"output": other, "summary": other}, {})
    check_targets({"output": "/dev/null", "summary": "/dev/null"}, {})


def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(TypeError), atomic_file(path) as part:
        part.write_text(0)
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert path.read_text() == "old"


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "a.txt", tmp_path / "a.txt"
    target.write_text("old")
    link.symlink_to(target)
    put(link)
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert [p.name for p in target.parent.iterdir()] == ["a.txt"]


def test_a_device_or_pipe_is_written_into(tmp_path):
    put("/dev/null")
    assert os.path.exists("/dev/null")
    assert not os.path.isfile("/dev/null")
    pipe, heard = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: heard.append(pipe.read_text()), daemon=True)
    reader.start()
    put(pipe)
    reader.join(10.0)
    assert heard == ["new"]
    assert [p.name for p in tmp_path.iterdir()] == ["pipe"]


def test_a_set_of_files_is_replaced_whole(tmp_path):
    for name in ("a.json", "b.yaml", "mine.txt"):
        (tmp_path / name).write_text("old")
    with replaced_files(tmp_path, ("b.yaml", "c.html", "a.json")) as staged:
        (staged / "a.json").write_text("new")
        (staged / "c.html").write_text("new")
        assert (tmp_path / "a.json").read_text() == "old"
    found = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert found == {"a.json": "new", "c.html": "new", "mine.txt": "old"}


def test_a_set_of_files_that_was_not_finished_changes_nothing(tmp_path):
    (tmp_path / "a.json").write_text("old")

    def interrupted(staged):
        (staged / "a.json").write_text("new")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), replaced_files(tmp_path, ("a.json",)) as staged:
        interrupted(staged)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.json": "old"}
