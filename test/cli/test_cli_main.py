"""The command line's frame: lazy commands, exit codes and one-line errors."""

import os
import subprocess
import sys
import time
import types
import warnings
from pathlib import Path

import pytest

import ctr_dynamics
from ctr_dynamics.cli import main as cli
from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.compiler import _say_not_kept


@pytest.fixture
def command(monkeypatch):
    """Put a function in the place of a command; returns a caller of the command line."""

    def install(function):
        module = types.ModuleType("ctr_dynamics.cli.info_command")
        module.info = function
        monkeypatch.setattr(cli, "available", lambda: ["info", "warmup"])
        monkeypatch.setattr(cli, "import_module", {"ctr_dynamics.cli.info_command": module}.__getitem__)
        return lambda *arguments: cli.main(["info", *arguments])

    return install


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"ctr-dynamics {ctr_dynamics.__version__}\n"


def test_help_names_every_command_and_imports_none(capsys):
    code = (
        "import sys; from ctr_dynamics.cli.main import main; code = main(['--help']); "
        "assert 'numba' not in sys.modules and 'rclpy' not in sys.modules; sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in cli.available():
        assert f"  {name} " in done.stdout


@pytest.mark.parametrize(("returned", "code"), [(None, 0), (0, 0), (1, 1)])
def test_what_a_command_returns_is_the_exit_code(command, returned, code):
    def info() -> int | None:
        return returned

    assert command(info)() == code


def test_arguments_reach_the_command_with_their_types(command):
    seen = []

    def info(bag: str, nodes: int = 24) -> None:
        seen.append((bag, nodes))

    assert command(info)("a.mcap", "--nodes", "100") == 0
    assert seen == [("a.mcap", 100)]


def test_input_error_is_one_line_and_exit_code_2(command, capsys):
    def info() -> None:
        raise InputError("tube is 300 m long,\nmore than 2 m", do="give metres", where="r.yaml")

    assert command(info)() == 2
    captured = capsys.readouterr()
    assert captured.err == "ctr-dynamics: error: r.yaml: tube is 300 m long, more than 2 m; give metres\n"
    assert captured.out == ""


def test_unreadable_file_is_one_line_and_exit_code_2(command, capsys):
    def info() -> None:
        Path("/nonexistent/bag.mcap").read_bytes()

    assert command(info)() == 2
    assert (
        capsys.readouterr().err == "ctr-dynamics: error: /nonexistent/bag.mcap: No such file or directory\n"
    )


def test_interrupt_is_exit_code_130(command, capsys):
    def info() -> None:
        raise KeyboardInterrupt

    assert command(info)() == 130
    assert capsys.readouterr().err == "ctr-dynamics: error: interrupted\n"


def test_bugs_are_not_hidden(command):
    def info() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        command(info)()


@pytest.mark.parametrize("arguments", [["nope"], ["--nope"], ["info", "--nope"], []])
def test_bad_arguments_are_exit_code_2(command, arguments):
    def info() -> None:
        pass

    command(info)
    assert cli.main(arguments) == 2


@pytest.mark.parametrize("name", ["robot", "info"])
def test_a_terminal_of_few_characters_is_no_error(name):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    arguments = {"robot": ["check", "till2020_tissue"], "info": ["n\u00fcrnberg.mcap"]}[name]
    command = [sys.executable, "-m", "ctr_dynamics.cli.main", name, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert b"Traceback" not in done.stderr
    assert done.returncode == (2 if name == "info" else 0)
    assert (name == "robot") or b"n\\xfcrnberg" in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("buffered", ["", "1"])
def test_output_that_cannot_be_written_is_one_line_and_exit_code_2(buffered):
    command = [sys.executable, "-m", "ctr_dynamics.cli.main", "--version"]
    environment = {**os.environ, "PYTHONUNBUFFERED": buffered}
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=environment
        )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "standard output cannot be written (No space left on device)" in done.stderr


def test_a_command_prepares_its_process_before_numpy_is_imported():
    code = (
        "import os, sys; from ctr_dynamics.cli.main import main; assert 'numpy' not in sys.modules; "
        "assert main(['--version']) == 0; print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    env = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    shown = subprocess.check_output([sys.executable, "-c", code], env=env, text=True)
    assert shown.split()[-1] == "1"


def test_warnings_of_the_package_are_one_line_and_those_of_others_keep_their_place(command, capsys):
    def info() -> None:
        _say_not_kept(Path("cache"), "Read-only file system")
        warnings.warn("of another", RuntimeWarning, stacklevel=1)

    assert command(info)() == 0
    own, other = capsys.readouterr().err.splitlines()[:2]
    assert own.startswith(
        "ctr-dynamics: warning: compiled kernels cannot be kept in cache (Read-only file system)"
    )
    assert other.endswith("RuntimeWarning: of another")
    assert Path(__file__).name in other


def test_termination_leaves_no_parts_of_files(tmp_path):
    """SIGTERM in the middle of a simulation ends it as Ctrl-C does."""
    command = [
        sys.executable,
        "-m",
        "ctr_dynamics.cli.main",
        "simulate",
        "sweep",
        "--robot",
        "till2020_tissue",
    ]
    process = subprocess.Popen(
        [*command, "--output", str(tmp_path / "out.mcap")], stderr=subprocess.PIPE, text=True
    )
    try:
        deadline = time.monotonic() + 60.0
        while not list(tmp_path.iterdir()) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        assert [path.suffix for path in tmp_path.iterdir()] == [".part"]
        process.terminate()
        error = process.communicate(timeout=60.0)[1]
    finally:
        process.kill()
    assert process.returncode == 130, error
    assert error.endswith("ctr-dynamics: error: terminated\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["replay", "a.mcap", "--robbot", "x"], "No such option: --robbot"),
        (["replay"], "Missing argument"),
        (["align", "a.mcap"], "Missing option"),
        (["diagnose", "a.mcap", "--workers", "0"], "'--workers'"),
        (["relpay"], "No such command 'relpay'"),
        (["robot", "chek"], "No such command 'chek'"),
    ],
)
def test_misused_arguments_are_one_line(capsys, arguments, says):
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("ctr-dynamics: error: ")
    assert error.count("\n") == 1
    assert says in error
    assert "--help`" in error


@pytest.mark.parametrize("arguments", [[], ["robot"]])
def test_without_a_command_the_help_is_shown(capsys, arguments):
    assert cli.main(arguments) == 2
    assert "Usage: ctr-dynamics" in capsys.readouterr().out
