from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import pytest
from omegaconf import DictConfig

from torchrl_l1.cli import main
from torchrl_l1.experiment.evaluate import Condition, conditions, evaluate, load_run
from torchrl_l1.experiment.robustness import summarize, table
from torchrl_l1.experiment.run import run

Recipe = Callable[..., DictConfig]


def test_conditions_vary_bias_and_gain_apart() -> None:
    cells = conditions(["off", "paper"], ["none"], [0.0, 1.0], [1.0, 0.5], ["stochastic"])
    disturbances = [(cell.bias, cell.gain) for cell in cells if cell.l1 == "off"]
    assert disturbances == [(0.0, 1.0), (1.0, 1.0), (0.0, 0.5)]
    assert len(cells) == 6


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
        Condition("off", "none", 0.0, 1.0, "stochastic"),
        Condition("off", "none", 0.0, 1.0, "stochastic"),
        Condition("off", "none", 3.0, 1.0, "stochastic"),
        Condition("off", "both", 0.0, 1.0, "deterministic"),
    ]
    first, again, biased, noisy = (row["return_mean"] for row in evaluate(trained, cells, 4))
    assert first == again
    assert biased < first
    assert noisy not in (first, biased)


def test_summary_is_the_median_over_training_seeds() -> None:
    cell = {"policy": "stochastic", "noise": "none", "bias": 0.0, "gain": 1.0, "episodes": 5}
    rows = [
        {**cell, "l1": "off", "return_mean": value, "training_seed": seed}
        for seed, value in enumerate([-3.0, -1.0, -100.0])
    ]
    (entry,) = summarize(rows)
    assert (entry["return_median"], entry["return_lowest"]) == (-3.0, -100.0)
    assert "3 training seeds" in table([entry])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "nowhere"], "holds no run"),
        (["evaluate", "nowhere", "--l1", "of"], "unknown l1 setting 'of'; there are off, paper"),
        (["evaluate", "nowhere", "--noise", "loud"], "unknown noise setting"),
        (["evaluate", "nowhere", "--episodes", "0"], "--episodes must be positive"),
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
