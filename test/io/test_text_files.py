"""Files that a user names: devices, pipes, folders, large files and YAML that multiplies itself are one line each."""

import os
import tracemalloc

import pytest

from ctr_dynamics.csv_import.column_layout import read_layout
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.text_files import read_bytes
from ctr_dynamics.io.yaml_files import MAX_NODES, read_yaml
from ctr_dynamics.parameters.parameter_files import read_parameter_file
from ctr_dynamics.robot_files.loader import load_robot
from ctr_dynamics.simulation.scenario import load_scenario

READERS = [load_robot, load_scenario, read_parameter_file, read_layout, read_bytes]


@pytest.mark.parametrize("reader", READERS)
def test_a_pipe_and_a_device_are_refused_and_not_read(reader, tmp_path):
    pipe = tmp_path / "pipe.yaml"
    os.mkfifo(pipe)
    for path in (pipe, "/dev/zero"):
        with pytest.raises(InputError, match="device, pipe or socket"):
            reader(type(pipe)(path))


def test_a_file_over_the_limit_says_its_size(tmp_path):
    path = tmp_path / "large.yaml"
    path.write_bytes(b"a: 1\n" * 20)
    assert read_bytes(path, 100) == path.read_bytes()
    with pytest.raises(InputError, match="has 100 bytes, limit 99 bytes"):
        read_bytes(path, 99)


def merges(levels: int) -> str:
    lines = ["a: &a0 {x: 1}"]
    lines += [f"k{i}: &a{i} {{<<: [{','.join(10 * [f'*a{i - 1}'])}]}}" for i in range(1, levels + 1)]
    return "\n".join(lines)


def laughs(levels: int) -> str:
    lines = ["a: &a0 [1]"]
    lines += [f"k{i}: &a{i} [{','.join(10 * [f'*a{i - 1}'])}]" for i in range(1, levels + 1)]
    return "\n".join(lines)


@pytest.mark.parametrize("text", [merges(9), laughs(9), "a: &a [*a]", "a: &a {b: *a}"])
def test_aliases_and_merges_are_bounded(text):
    tracemalloc.start()
    with pytest.raises(InputError, match=r"aliases and merges stand for|holds itself"):
        read_yaml(text, "file.yaml")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24


def test_aliases_and_merges_within_the_limit_are_read():
    read = read_yaml(merges(3) + "\nlist: &l [1, 2]\nagain: *l\n", "file.yaml")
    assert read["k3"] == {"x": 1}
    assert read["again"] == [1, 2]
    assert len(read_yaml(f"[{','.join(['1'] * (MAX_NODES - 1))}]", "file.yaml")) == MAX_NODES - 1
