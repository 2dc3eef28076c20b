"""Campaigns of an algorithm with several stages."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.campaign import evaluation
from torchrl_l1.campaign.description import (
    CampaignError,
    EvaluationSettings,
    dump_yaml,
    load_yaml,
    read_campaign,
)
from torchrl_l1.campaign.evaluation import evaluate_run, is_evaluated
from torchrl_l1.campaign.plan import PlannedRun, plan
from torchrl_l1.cli import main
from torchrl_l1.experiment.evaluate import episodes_file
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.matrix import suite
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.report.runs import find_readable_runs

TINY = [
    *("outer_iterations=4", "shooting_iterations=1", "cloning.iterations=2", "horizon=8"),
    *(
        "random_episodes=3",
        "shooting_episodes=2",
        "evaluation_episodes=2",
        "fine_tuning.episodes=3",
    ),
    *("shooting.horizon=3", "shooting.candidates=8", "model.hidden=[8]", "policy.hidden=[8]"),
    *(
        "fine_tuning.value_hidden=[8]",
        "fine_tuning.minibatches=2",
        "fit.max_epochs=2",
        "fit.batch_size=8",
    ),
    *("fit.validation_fraction=0.3", "cloning.max_epochs=2", "cloning.episodes=2"),
    "wandb.mode=disabled",
]


def campaign_file(folder: Path, **evaluation: object) -> Path:
    file = folder / "stages.yaml"
    runs = {"recipe": "mbmf/inverted_pendulum", "overrides": TINY, "matrix": {"l1": ["off"]}}
    settings = {"name": "frozen", "policy": ["stochastic"], "episodes": 2} | evaluation
    file.write_text(dump_yaml({"runs": [runs], "evaluations": [settings]}))
    return file


def test_stages_are_evaluated_where_the_campaign_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = campaign_file(tmp_path, stage=["shooting", "fine_tuning"], bias=[0.0, 1.0])
    arguments = ["campaign", str(file), "--output", str(tmp_path / "out"), "--workers", "1"]
    main(arguments)
    (this,) = plan(read_campaign(str(file)), tmp_path / "out")
    with (this.directory.path / "evaluations/frozen.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert [(row["stage"], row["l1"], float(row["bias"])) for row in rows] == [
        (stage, l1, bias)
        for stage in ("shooting", "fine_tuning")
        for bias in (0.0, 1.0)
        for l1 in ("off", "paper")
    ]
    described = load_yaml(this.directory.path / "evaluations/frozen.yaml")
    assert described["stage"] == ["shooting", "fine_tuning"]
    assert "after 80 real steps" in capsys.readouterr().out
    (settings,) = this.evaluations
    assert is_evaluated(this.directory, settings)
    assert not is_evaluated(
        this.directory, replace(settings, matrix=settings.matrix | {"stage": ["shooting"]})
    )


def test_table_that_is_older_than_stages_is_of_the_last_one(tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path)
    table = tmp_path / "evaluations/e.csv"
    table.parent.mkdir()
    table.write_text("l1\n")
    settings = EvaluationSettings("e")
    described = {key: value for key, value in settings.of_a_run().items() if key != "stage"}
    table.with_suffix(".yaml").write_text(dump_yaml({**described, "iterations": 0}))
    assert is_evaluated(directory, settings)
    assert not is_evaluated(directory, EvaluationSettings("e", matrix={"stage": ["shooting"]}))


def test_stage_that_a_run_has_not_changes_nothing(tmp_path: Path) -> None:
    overrides = [*TINY, "outer_iterations=1", f"run_dir={tmp_path}"]
    directory = run(compose("mbmf/inverted_pendulum", overrides))
    settings = EvaluationSettings("e", matrix={"policy": ["stochastic"]}, episodes=1).of_a_run()
    before = evaluate_run(str(directory), "e", json.loads(json.dumps(settings))).read_bytes()
    with pytest.raises(ValueError, match="no stage 'fine_tuning' so far; there is shooting"):
        evaluate_run(str(directory), "e", {**settings, "stage": ["shooting", "fine_tuning"]})
    assert (directory / "evaluations/e.csv").read_bytes() == before
    assert (directory / "evaluations/e.yaml").exists()


def test_unknown_stage_is_refused_before_anything_starts(tmp_path: Path) -> None:
    file = campaign_file(tmp_path, stage=["shooting", "fine"])
    with pytest.raises(
        CampaignError, match=r"'fine'; the stages .* shooting, cloning, fine_tuning"
    ):
        plan(read_campaign(str(file)), tmp_path / "out")


@pytest.mark.parametrize(
    ("iterations", "asked", "reached"),
    [(3, "fine_tuning", "shooting, cloning"), (1, "cloning", "shooting")],
)
def test_stage_that_a_run_never_reaches_is_refused_before_anything_starts(
    tmp_path: Path, iterations: int, asked: str, reached: str
) -> None:
    campaign = read_campaign(str(campaign_file(tmp_path, stage=["shooting", asked])))
    assert len(plan(campaign, tmp_path / "out")) == 1
    campaign.runs[0].overrides.append(f"outer_iterations={iterations}")
    words = rf"outer_iterations={iterations} .* not reach the stage '{asked}', only {reached};"
    with pytest.raises(CampaignError, match=words):
        plan(campaign, tmp_path / "out")


def test_a_planner_is_tested_once(tmp_path: Path) -> None:
    """Tables that say both kinds of policies count all the same."""
    directory = run(compose("mbmf/inverted_pendulum", [*TINY, f"run_dir={tmp_path}"]))
    settings = EvaluationSettings(
        "e", matrix={"l1": ["off"], "stage": ["shooting", "cloning"]}, episodes=1
    )
    with evaluate_run(str(directory), "e", settings.of_a_run()).open() as handle:
        rows = [(row["stage"], row["policy"]) for row in csv.DictReader(handle)]
    assert rows == [
        *(("shooting", "stochastic"), ("cloning", "stochastic"), ("cloning", "deterministic")),
    ]
    assert is_evaluated(RunDirectory(directory), settings)


def test_a_suite_is_evaluated_and_made_again_when_it_has_changed(
    tiny_recipe: Callable[..., DictConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    matrix = {"l1": ["off", "oracle"], "policy": ["stochastic"]}
    settings = EvaluationSettings("robustness", matrix=matrix, suite="quick", episodes=2)
    table = evaluate_run(str(directory), "robustness", json.loads(json.dumps(settings.of_a_run())))
    with table.open() as handle:
        rows = list(csv.DictReader(handle))
    acting = len(suite("quick")) - 4  # no contacts, which two need, no rotors, and no 50th step
    assert [row["l1"] for row in rows] == ["off", "oracle"] * acting
    with episodes_file(table).open() as handle:
        episodes = list(csv.DictReader(handle))
    assert len(episodes) == 2 * len(rows)
    assert is_evaluated(RunDirectory(directory), settings)
    assert not is_evaluated(RunDirectory(directory), replace(settings, suite="full"))
    assert not is_evaluated(RunDirectory(directory), replace(settings, suite=None))
    fewer = suite("quick")[:-1]
    monkeypatch.setattr(evaluation, "suite", lambda _: fewer)
    assert not is_evaluated(RunDirectory(directory), settings)


def test_the_campaign_of_robustness_tests_every_run_with_the_oracle(tmp_path: Path) -> None:
    campaign = read_campaign("robustness")
    for settings in campaign.evaluations:
        assert settings.suite == "full" and settings.matrix["l1"][-1] == "oracle"
        settings.matrix["l1"] = ["off", "paper", "oracle"]
    runs = plan(campaign, tmp_path / "out")
    assert {run.values["recipe"] for run in runs} == {
        *(f"metrpo/{task}" for task in ("inverted_pendulum", "swimmer", "half_cheetah")),
        *("metrpo/hopper", "metrpo/walker", "pets/inverted_pendulum"),
    }
    assert all(len(run.evaluations) == 1 and run.values["l1"] == "off" for run in runs)


@pytest.mark.parametrize(
    ("shooting", "cloning", "fine_tuning", "visits", "practice"), [(3, 2, 4, 5, 7), (1, 1, 0, 1, 1)]
)
def test_steps_are_those_that_the_algorithm_counts(
    shooting: int, cloning: int, fine_tuning: int, visits: int, practice: int
) -> None:
    overrides = {
        "shooting_iterations": shooting,
        "outer_iterations": shooting + cloning + fine_tuning,
    }
    config = OmegaConf.merge(
        compose("mbmf/inverted_pendulum", [*TINY, "run_dir=unused"]),
        {**overrides, "cloning": {"iterations": cloning, "episodes": visits}},
        {"fine_tuning": {"episodes": practice}},
    )
    algorithm = OmegaConf.to_object(config).build()
    planned = PlannedRun({}, 0, 0, RunDirectory("unused"), config)
    counted = [result.metrics["real_steps"] for result in algorithm.iterate()]
    random = algorithm.start.frames
    assert [planned.collected_steps(i) for i in range(planned.iterations + 1)] == [
        count - random for count in (random, *counted)
    ]


@pytest.mark.parametrize("spoilt", ["damaged.csv", "episodes/damaged.csv"])
def test_a_damaged_table_is_made_again_and_not_reported(
    spoilt: str, tiny_recipe: Callable[..., DictConfig]
) -> None:
    """Each is a table as before: without its last line, or with another digit."""
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    settings = EvaluationSettings("damaged", matrix={"l1": ["off"], "bias": [0.0, 1.0]}, episodes=2)
    evaluate_run(str(directory), settings.name, settings.of_a_run())
    file = directory / "evaluations" / spoilt
    whole = file.read_text()

    def seen() -> tuple[bool, bool]:
        found = find_readable_runs([directory])
        told = [error for error in found.errors if "damaged.csv or the table" in str(error)]
        assert bool(found.runs[0].evaluations) != bool(told)
        return is_evaluated(RunDirectory(directory), settings), not told

    assert seen() == (True, True)
    for text in (whole[: whole.rindex("\n", 0, -1) + 1], whole.replace("1.0", "1.1", 1)):
        file.write_text(text)
        assert seen() == (False, False)
    file.write_bytes(whole.replace("\n", "\r\n").encode())  # as some tools copy text
    assert seen() == (True, True)
    file.write_text("")
    evaluate_run(str(directory), settings.name, settings.of_a_run())
    assert seen() == (True, True) and file.read_text() == whole


def test_a_kill_leaves_no_table_of_older_settings(
    tiny_recipe: Callable[..., DictConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    settings = EvaluationSettings("e", matrix={"l1": ["off"]}, episodes=2)
    evaluate_run(str(directory), "e", settings.of_a_run())
    assert find_readable_runs([directory]).runs[0].evaluations
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(evaluation, "write_table", Mock(side_effect=KeyboardInterrupt))
        evaluate_run(str(directory), "e", replace(settings, seed=1).of_a_run())
    found = find_readable_runs([directory])
    assert not found.runs[0].evaluations and not found.errors
