from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import pytest
from omegaconf import DictConfig

from torchrl_l1.cli import main
from torchrl_l1.experiment.evaluate import evaluate, load_run
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.experiment.run import run

Recipe = Callable[..., DictConfig]


def test_evaluate_sweeps_epsilon_and_alpha(
    tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(tiny_recipe("l1=off"))
    sweep = ["--epsilon", "1e-9", "1e9", "--alpha", "0.05", "--policy", "stochastic"]
    main(["evaluate", str(directory), "--bias", "0", "--episodes", "2", *sweep])
    with (directory / "evaluation" / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["l1"] for row in rows] == ["off", "paper", "paper"]
    assert (rows[0]["epsilon"], rows[0]["alpha"]) == ("", "")
    assert [(float(row["epsilon"]), float(row["alpha"])) for row in rows[1:]] == [
        (1e-9, 0.05),
        (1e9, 0.05),
    ]
    # A tolerance of nearly nothing moves the operating point whenever a unit of the network has
    # changed sides since (it is linear else), a huge one never.
    often, never = (float(row["l1/switch_rate"]) for row in rows[1:])
    assert often > 0.3 and never == 0
    labels = ["off", "paper epsilon=1e-09 alpha=0.05", "paper epsilon=1e+09 alpha=0.05"]
    with (directory / "evaluation" / "summary.csv").open() as file:
        assert [row["l1"] for row in csv.DictReader(file)] == labels
    heading = capsys.readouterr().out.split("|\n")[0].splitlines()[-1]
    controllers = [cell.strip() for cell in heading.strip("|").split("|")]
    assert controllers == [f"L1 {label}" for label in labels]


def test_evaluate_writes_table_and_plot(
    tiny_recipe: Recipe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(tiny_recipe())
    main(["evaluate", str(directory), "--bias", "0", "2", "--episodes", "3", "--l1", "off", "slow"])
    with (directory / "evaluation" / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 2
    assert {row["episodes"] for row in rows} == {"3"}
    picture = matplotlib.image.imread(directory / "evaluation" / "robustness.png")
    assert picture.std() > 0.05
    printed = capsys.readouterr().out
    assert "deterministic policy" in printed
    assert "robustness.png" in printed


def test_cells_share_their_random_numbers_and_see_their_disturbance(tiny_recipe: Recipe) -> None:
    trained = load_run(run(tiny_recipe()))
    cells = [
        Condition("off"),
        Condition("off"),
        Condition("off", disturbances={"bias": 3.0}),
        Condition("off", "both", policy="deterministic"),
    ]
    first, again, biased, noisy = (row["return_mean"] for row in evaluate(trained, cells, 4))
    assert first == again
    assert biased < first
    assert noisy not in (first, biased)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "nowhere"], "holds no run"),
        (["evaluate", "nowhere", "--l1", "of"], "unknown l1 setting 'of'; there are off, paper"),
        (["evaluate", "nowhere", "--noise", "loud"], "unknown noise setting"),
        (["evaluate", "nowhere", "--episodes", "0"], "--episodes must be positive"),
        (["evaluate", "nowhere", "--epsilon", "1", "0"], "--epsilon must be positive and finite"),
        (["evaluate", "nowhere", "--epsilon", "inf"], "--epsilon must be positive and finite"),
        (["evaluate", "nowhere", "--alpha", "0.1", "1.5"], "--alpha must be above 0 and at most 1"),
        (["evaluate", "nowhere", "--alpha", "nan"], "--alpha must be above 0 and at most 1"),
        (["evaluate", "nowhere", "--bias", "0", "inf"], "--bias must be finite, got inf"),
        (["evaluate", "nowhere", "--gain", "weak"], "argument --gain: invalid float value"),
        (["evaluate", "nowhere", "--policy", "greedy"], "argument --policy: invalid choice"),
        (["verify", "nowhere.npz"], "no trace file"),
        (["run", "metrpo/inverted_pendlum"], "Did you mean metrpo/inverted_pendulum"),
    ],
)
def test_bad_requests_exit_with_one_clear_line(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        main(arguments)
    assert exit_info.value.code != 0
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_typo_in_an_override_fails_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        main(["run", "metrpo/inverted_pendulum", "sed=3"])
    assert exit_info.value.code != 0
    assert "sed" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
