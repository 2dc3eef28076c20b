"""Runs of algorithms that plan, through everything that runs of METRPO go through."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig

from torchrl_l1.algorithms import PETS
from torchrl_l1.campaign.description import dump_yaml, read_campaign
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main
from torchrl_l1.experiment.evaluate import evaluate, load_run
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.matrix import conditions
from torchrl_l1.experiment.run import run

METRICS = PETS.facts.metrics

TINY = [
    "outer_iterations=2",
    "horizon=10",
    "random_episodes=2",
    "random_steps=8",
    "particles=2",
    "cem.horizon=3",
    "cem.candidates=8",
    "cem.elites=2",
    "cem.iterations=1",
    "model.members=2",
    "model.hidden=[8]",
    "fit.max_epochs=2",
    "fit.validation_fraction=0.3",
    "wandb.mode=disabled",
]
Make = Callable[..., DictConfig]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def make(*overrides: str, recipe: str = "pets/inverted_pendulum") -> DictConfig:
        return compose(recipe, [*TINY, f"run_dir={tmp_path / 'run'}", *overrides])

    return make


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as handle:
        return list(csv.DictReader(handle))


@pytest.mark.parametrize("recipe", ["pets/inverted_pendulum", "dets/inverted_pendulum"])
def test_run_directory_has_what_is_promised(
    recipe: str, make: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(make("precision=float32", recipe=recipe))
    rows = rows_of(directory / "metrics.csv")
    assert [int(row["real_steps"]) for row in rows] == [26, 36]
    assert set(rows[0]) == set(METRICS)
    assert set(rows_of(directory / "timing.csv")[0]) == {
        "iteration",
        "random",
        "fit",
        "collect",
        "evaluate",
    }
    assert torch.load(directory / "model.pt", weights_only=True)
    assert not (directory / "policy.pt").exists(), "a planner has no weights of its own"
    assert "device cpu, precision float32" in capsys.readouterr().out


def test_interrupted_run_goes_on_as_if_it_had_not_been(make: Make, tmp_path: Path) -> None:
    whole = run(make(f"run_dir={tmp_path / 'whole'}", "outer_iterations=3"))
    run(make("outer_iterations=1"))
    resumed = run(make("resume=true", "outer_iterations=3"))
    assert (resumed / "metrics.csv").read_text() == (whole / "metrics.csv").read_text()


def test_frozen_planner_is_evaluated_under_disturbances(
    make: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(make("l1=off"))
    capsys.readouterr()
    command = ["evaluate", str(directory), "--l1", "off", "paper", "--bias", "0", "1"]
    main([*command, "--episodes", "3"])
    # It acts in one way only, so sampled and mean actions would say the same twice.
    rows = rows_of(directory / "evaluation/evaluation.csv")
    assert [(row["policy"], row["l1"], float(row["bias"])) for row in rows] == [
        ("stochastic", "off", 0.0),
        ("stochastic", "paper", 0.0),
        ("stochastic", "off", 1.0),
        ("stochastic", "paper", 1.0),
    ]
    assert len({row["return_mean"] for row in rows}) == 4
    assert (directory / "evaluation/robustness.png").exists()


def test_bias_acts_after_the_planner(make: Make) -> None:
    trained = load_run(run(make("l1=off")))
    cells = conditions(l1=["off"], bias=[0.0, 2.9], policy=["stochastic"])
    first, second = evaluate(trained, cells, episodes=2)
    assert first["return_mean"] != second["return_mean"]
    again = next(evaluate(trained, cells, episodes=2))
    assert again["return_mean"] == first["return_mean"], "the same random numbers every time"


def test_campaign_over_two_algorithms(tmp_path: Path, start_cli: Callable[..., Any]) -> None:
    file = tmp_path / "both.yaml"
    matrix = {"l1": ["off", "paper"], "seed": [0]}
    recipes = ("pets/inverted_pendulum", "dets/inverted_pendulum")
    runs = [{"recipe": name, "overrides": TINY, "matrix": matrix} for name in recipes]
    file.write_text(dump_yaml({"runs": runs}))
    planned = plan(read_campaign(str(file)), tmp_path / "out")
    assert {one.config.model.head for one in planned} == {"gaussian", "deterministic"}
    command = ["campaign", str(file), "--output", str(tmp_path / "out"), "--workers", "2"]
    assert start_cli(command).wait() == 0, (tmp_path / "output").read_text()
    assert all(one.problem() is None for one in planned)
    settings = json.dumps([one.settings() for one in planned])
    assert '"algorithm": "pets"' in settings


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("cem.elites=9", "must not exceed"),
        ("propagation=ts2", "propagation"),
        ("precision=float16", "precision"),
        ("random_steps=0", "random_steps"),
        ("replan_every=4", "replan_every"),
        ("fit.weight_decay=[-1]", "weight_decay"),
    ],
)
def test_bad_settings_are_named_before_anything_starts(
    override: str, message: str, make: Make, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        run(make(override))
    assert not (tmp_path / "run").exists()
