from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import pytest
from omegaconf import DictConfig

from torchrl_l1.cli import main
from torchrl_l1.cli.robustness import summarize, table
from torchrl_l1.experiment.evaluate import Condition, conditions, evaluate, load_run
from torchrl_l1.experiment.run import run

Recipe = Callable[..., DictConfig]


def test_conditions_vary_bias_and_gain_apart() -> None:
    cells = conditions(["off", "paper"], ["none"], [0.0, 1.0], [1.0, 0.5], ["stochastic"])
    disturbances = [(cell.bias, cell.gain) for cell in cells if cell.l1 == "off"]
    assert disturbances == [(0.0, 1.0), (1.0, 1.0), (0.0, 0.5)]
    assert len(cells) == 6


def test_conditions_sweep_epsilon_and_alpha_but_not_without_l1() -> None:
    sweep = ([0.1, 1.0, 0.1], [0.05, 0.35])
    cells = conditions(
        ["off", "paper", "slow"], ["none"], [0.0, 1.0], [1.0], ["stochastic"], *sweep
    )
    assert len(cells) == len(set(cells)) == 2 * (1 + 2 * 2 * 2)
    off = [(cell.epsilon, cell.alpha) for cell in cells if cell.l1 == "off"]
    assert off == [(None, None)] * 2
    on = {(cell.epsilon, cell.alpha) for cell in cells if cell.l1 == "slow" and cell.bias == 1.0}
    assert on == {(0.1, 0.05), (0.1, 0.35), (1.0, 0.05), (1.0, 0.35)}
    only_alpha = conditions(["paper"], ["none"], [0.0], [1.0], ["stochastic"], alpha=[0.2])
    assert [(cell.epsilon, cell.alpha) for cell in only_alpha] == [(None, 0.2)]


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
    # A tolerance of nearly nothing moves the operating point again and again, a huge one never.
    often, never = (float(row["l1/switch_rate"]) for row in rows[1:])
    assert often > 0.9 and never == 0
    labels = ["off", "paper epsilon=1e-09 alpha=0.05", "paper epsilon=1e+09 alpha=0.05"]
    with (directory / "evaluation" / "summary.csv").open() as file:
        assert [row["l1"] for row in csv.DictReader(file)] == labels
    heading = capsys.readouterr().out.split("bias")[1].splitlines()[0]
    assert heading.split() == ["gain", *" ".join(labels).split()]


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


def test_each_panel_counts_its_own_seeds() -> None:
    cell = {"noise": "none", "bias": 0.0, "gain": 1.0, "episodes": 5, "l1": "off"}
    rows = [
        {**cell, "policy": policy, "return_mean": -1.0}
        for policy in ("stochastic", "stochastic", "deterministic")
    ]
    both, one = table(summarize(rows)).split("\n\n")
    assert "stochastic" in both and "of 2 training seeds" in both
    assert "deterministic" in one and one.count("of 1 training seed\n") == 1


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
