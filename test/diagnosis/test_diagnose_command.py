"""The diagnose command as a user meets it: outcome, bad input, and a Dask cluster."""

import json

import pytest
from truth.cases import make_case

from ctr_dynamics.cli.main import main, spread
from ctr_dynamics.diagnosis.output.findings_keys import undocumented


@pytest.fixture(scope="module")
def resting(tmp_path_factory):
    """Two short bags in which nothing moves."""
    return make_case(92001, "not_excited", tmp_path_factory.mktemp("rest"), duration_s=4.0)


def test_command_on_a_local_cluster(resting, tmp_path, capsys):
    """Findings come back from a worker, files are written, one line of JSON is printed."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        code = main(
            [
                "diagnose", str(resting.protocol), "--validate", str(resting.sweep), "--robot", "till2020_tissue", "--output",
                str(tmp_path / "out"), "--json", "--cluster", cluster.scheduler_address,
            ]
        )  # fmt: skip
    assert code == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["verdict"] == "not_excited"
    assert printed["next_experiment"]["scenario_file"] == "next_experiment.yaml"
    assert undocumented(json.loads((tmp_path / "out" / "findings.json").read_text())) == set()


def test_next_experiment_can_be_simulated(resting, tmp_path, capsys):
    """Without a validation bag the summary says what that costs; its scenario is one that `simulate` takes."""
    out = tmp_path / "out"
    assert (
        main(
            [
                "diagnose",
                str(resting.protocol),
                "--robot",
                "till2020_tissue",
                "--output",
                str(out),
                "--no-report",
            ]
        )
        == 0
    )
    shown = capsys.readouterr()
    assert "verdict: not_excited" in shown.out
    assert "without a validation bag" in shown.err
    from ctr_dynamics.simulation.scenario import load_scenario

    assert load_scenario(out / "next_experiment.yaml").duration_s > 1.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.mcap", "--robot", "till2020_tissue"], "no such file"),
        (["BAG", "--robot", "three_tube"], "no complete joint state of robot"),
        (
            ["BAG", "--robot", "till2020_tissue", "--cluster", "tcp://127.0.0.1:1"],
            "no Dask scheduler answers",
        ),
        (["README.md", "--robot", "till2020_tissue"], "README.md"),
        (["BAG", "--validate", "BAG", "--robot", "till2020_tissue"], "is the same bag as"),
    ],
)
def test_bad_input_is_one_line_and_code_2(resting, tmp_path, capsys, arguments, words):
    arguments = [str(resting.protocol) if a == "BAG" else a for a in arguments]
    assert main(["diagnose", *arguments, "--output", str(tmp_path / "out")]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ctr-dynamics: error")]
    assert len(lines) == 1
    assert words in lines[0]
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_is_said_before_the_work(resting, tmp_path, capsys):
    (tmp_path / "taken").write_text("")
    arguments = ["diagnose", str(resting.protocol), "--robot", "till2020_tissue", "--output"]
    assert main([*arguments, str(tmp_path / "taken")]) == 2
    error = capsys.readouterr().err
    assert "is a file, a folder is expected" in error
    assert "reading" not in error


def test_validate_takes_every_bag_up_to_the_next_option():
    given = ["diagnose", "a", "--validate", "b", "c", "--robot", "r", "--validate", "d", "--json"]
    assert spread(given, ("--validate",)) == [
        "diagnose", "a", "--validate", "b", "--validate", "c", "--robot", "r", "--validate", "d", "--json",
    ]  # fmt: skip
