from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import pytest
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.algorithms import MBMF
from torchrl_l1.algorithms.facts import KINDS
from torchrl_l1.algorithms.policy import kinds_of
from torchrl_l1.cli import evaluate as evaluate_command
from torchrl_l1.cli import main
from torchrl_l1.experiment.evaluate import TrainedRun, evaluate, load_run
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.settings import SCHEMAS

from .conftest import rows_of

Recipe = Callable[..., DictConfig]

MBMF_STAGES = MBMF.facts.stage_names

TINY = [
    *("outer_iterations=3", "shooting_iterations=1", "cloning.iterations=1", "horizon=8"),
    *(
        "random_episodes=3",
        "shooting_episodes=2",
        "evaluation_episodes=2",
        "fine_tuning.episodes=2",
    ),
    *("shooting.horizon=3", "shooting.candidates=8", "model.hidden=[8]", "policy.hidden=[8]"),
    *(
        "fine_tuning.value_hidden=[8]",
        "fine_tuning.minibatches=2",
        "fit.max_epochs=2",
        "fit.batch_size=8",
    ),
    *("fit.validation_fraction=0.3", "cloning.max_epochs=2", "l1=off", "wandb.mode=disabled"),
]


def train(folder: Path, *overrides: str) -> Path:
    return run(compose("mbmf/inverted_pendulum", [*TINY, f"run_dir={folder}", *overrides]))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("stages") / "run")


def test_stages_of_each_algorithm_are_known(trained: Path) -> None:
    for name in ("metrpo", "pets"):
        config = compose(f"{name}/inverted_pendulum", ["run_dir=unused", "model.hidden=[8]"])
        assert (
            tuple(OmegaConf.to_object(config).build().policies)
            == SCHEMAS[name].builds.facts.stage_names
        )
    assert tuple(load_run(trained).algorithm.policies) == MBMF_STAGES


@pytest.mark.parametrize("iterations", range(1, 7))
def test_settings_tell_which_stages_a_run_reaches(iterations: int) -> None:
    rounds = ["shooting_iterations=2", "cloning.iterations=3", f"outer_iterations={iterations}"]
    recipe = OmegaConf.to_object(compose("mbmf/inverted_pendulum", [*TINY, *rounds, "run_dir=no"]))
    algorithm = recipe.build()
    algorithm.iteration = iterations
    assert recipe.stages() == tuple(algorithm.policies)
    assert len(recipe.stages()) == 1 + (iterations > 2) + (iterations > 5)


def test_planners_act_in_one_way_and_policies_in_two(trained: Path) -> None:
    policies = load_run(trained).algorithm.policies
    assert {name: len(kinds_of(policy)) for name, policy in policies.items()} == {
        "shooting": 1,
        "cloning": 2,
        "fine_tuning": 2,
    }


def test_each_stage_is_evaluated_on_its_own(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", str(trained), "--l1", "off", "paper", "--bias", "0", "1"]
    main([*command, "--episodes", "2", "--output", str(tmp_path), "--stage", *MBMF_STAGES])
    rows = rows_of(tmp_path / "evaluation.csv")
    cells = {(row["stage"], row["policy"]) for row in rows}
    # The planner's sampled and mean actions would say the same twice.
    assert cells == {
        ("shooting", "stochastic"),
        *((stage, kind) for stage in ("cloning", "fine_tuning") for kind in KINDS),
    }
    assert len(rows) == 5 * 2 * 2
    returns = {row["stage"]: row["return_mean"] for row in rows if row["policy"] == "stochastic"}
    assert len(set(returns.values())) == 3, "three policies"
    printed = capsys.readouterr().out
    assert "shooting, stochastic policy, noise none" in printed
    assert "shooting, deterministic" not in printed
    assert len(rows_of(tmp_path / "summary.csv")) == len(rows)
    assert matplotlib.image.imread(tmp_path / "robustness.png").std() > 0.05


def test_last_stage_is_the_default_and_is_named(trained: Path) -> None:
    loaded = load_run(trained)
    default, named, other = (
        next(evaluate(loaded, [Condition("off", stage=name)], 2))
        for name in (None, "fine_tuning", "cloning")
    )
    assert default["stage"] == named["stage"] == "fine_tuning"
    assert default["return_mean"] == named["return_mean"] != other["return_mean"]


def test_stage_not_reached_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    early = train(tmp_path / "early", "outer_iterations=2")
    output = tmp_path / "output"
    for names in (["fine_tuning"], ["cloning", "fine_tuning"]):
        with pytest.raises(SystemExit):
            main(["evaluate", str(early), "--stage", *names, "--output", str(output)])
        error = capsys.readouterr().err
        assert "no stage 'fine_tuning' so far; there are shooting, cloning" in error
        assert str(early) in error
    assert not output.exists()


def test_runs_that_are_differently_far_need_the_name_of_the_stage(tmp_path: Path) -> None:
    runs = [
        TrainedRun(tmp_path / name, None, SimpleNamespace(policies=dict.fromkeys(stages)))
        for name, stages in {"one": MBMF_STAGES[:1], "two": MBMF_STAGES[:2]}.items()
    ]
    with pytest.raises(ValueError, match=r"one has reached the stage shooting and .*two cloning"):
        evaluate_command._stages(runs, [])
    assert evaluate_command._stages(runs, ["shooting"]) == ["shooting"]


def test_runs_that_are_differently_far_share_a_table(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    early = train(tmp_path / "early", "outer_iterations=1", "seed=1")
    config = OmegaConf.load(early / "config.yaml")
    config.outer_iterations = 3  # as if it were still running
    OmegaConf.save(config, early / "config.yaml")
    command = ["evaluate", str(early), str(trained), "--episodes", "1", "--output", str(tmp_path)]
    main([*command, "--stage", "shooting", "--l1", "off"])
    rows = rows_of(tmp_path / "evaluation.csv")
    assert [(row["training_seed"], row["stage"]) for row in rows] == [
        *(("1", "shooting"), ("0", "shooting")),
    ]
    (entry,) = rows_of(tmp_path / "summary.csv")
    assert (entry["stage"], entry["training_seeds"]) == ("shooting", "2")
    assert "of 2 training seeds" in capsys.readouterr().out


def test_runs_with_compiled_plans_are_evaluated_without(tmp_path: Path) -> None:
    loaded = load_run(train(tmp_path / "run", "outer_iterations=1", "compile_plans=auto"))
    assert loaded.recipe.compile_plans == "auto"
    assert loaded.algorithm.planner.sampler.compile is False


def test_rows_of_a_single_stage_are_as_they_were(tiny_recipe: Recipe) -> None:
    loaded = load_run(run(tiny_recipe("outer_iterations=1")))
    cell = Condition("off")
    (row,) = evaluate(loaded, [cell], 2)
    assert "stage" not in row
    with pytest.raises(ValueError, match="no stage 'shooting' so far; there is policy"):
        next(evaluate(loaded, [replace(cell, stage="shooting")], 2))


def test_filmstrip_has_a_row_for_each_stage_and_controller(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    monkeypatch.setattr(evaluate_command, "rollout_frames", lambda task, poses: [poses])
    monkeypatch.setattr(evaluate_command, "filmstrip", lambda rows, *_, **__: shown.extend(rows))
    monkeypatch.setattr(evaluate_command, "animation", lambda *_, **__: None)
    command = ["evaluate", str(trained), "--episodes", "1", "--filmstrip", "--output"]
    main([*command, str(tmp_path / "two"), "--stage", "shooting", "cloning"])
    assert shown == [
        f"{stage}\nL1 {l1}" for stage in ("shooting", "cloning") for l1 in ("off", "paper")
    ]
    shown.clear()
    main([*command, str(tmp_path / "one"), "--stage", "cloning"])
    assert shown == ["L1 off", "L1 paper"]


def test_filmstrip_is_of_the_worst_value_alone(
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Whichever disturbance it is: that of the first one is in every evaluation, undisturbed."""
    drawn: list[Condition] = []

    def poses(trained: object, cell: Condition, steps: int, seed: int) -> list[int]:
        drawn.append(cell)
        return [0]

    monkeypatch.setattr(evaluate_command, "_poses", poses)
    monkeypatch.setattr(evaluate_command, "rollout_frames", lambda task, poses: [poses])
    monkeypatch.setattr(evaluate_command, "filmstrip", lambda rows, path, **__: path)
    monkeypatch.setattr(evaluate_command, "animation", lambda rows, path, **__: path)
    command = ["evaluate", str(trained), "--episodes", "1", "--l1", "off", "--filmstrip"]
    for name, values, worst in (("gain", ["1", "0.5"], 0.5), ("bias", ["-1", "0"], -1.0)):
        main([*command, "--output", str(tmp_path / name), f"--{name}", *values])
        assert f"Filmstrip at {name} {worst:g}: " in capsys.readouterr().out
        assert [cell.disturbances[name] for cell in drawn] == [worst]
        drawn.clear()
