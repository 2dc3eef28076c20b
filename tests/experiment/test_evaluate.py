from __future__ import annotations

import csv
import errno
import io
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.algorithms import MBMF
from torchrl_l1.algorithms.facts import KINDS
from torchrl_l1.algorithms.policy import kinds_of
from torchrl_l1.cli import evaluate as evaluate_command
from torchrl_l1.cli import main
from torchrl_l1.experiment.evaluate import TrainedRun, evaluate, evaluate_episodes, load_run
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.matrix import Condition, suite
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.settings import SCHEMAS

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


def test_tables_do_not_depend_on_what_reads_the_output(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = run(tiny_recipe("l1=off"))
    options = ["--l1", "off", "--bias", "0", "--policy", "deterministic"]
    command = ["evaluate", str(directory), *options, "--episodes", "1", "--output"]
    latin = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(sys, "stdout", latin)
    main([*command, str(tmp_path / "δ")])
    assert rb"/\u03b4/evaluation.csv" in latin.buffer.getvalue()

    class Ended(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Ended())
    with pytest.raises(SystemExit):
        main([*command, str(tmp_path / "ended")])
    monkeypatch.undo()
    for name in ("evaluation", "episodes", "summary"):
        one, other = (tmp_path / folder / f"{name}.csv" for folder in ("δ", "ended"))
        assert one.read_text() == other.read_text()


def test_a_folder_that_takes_no_results_is_told_before_the_work(
    tiny_recipe: Recipe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    monkeypatch.setattr(evaluate_command, "evaluate_episodes", None)

    def read_only(descriptor: int) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "fsync", read_only)
    with pytest.raises(SystemExit):
        main(["evaluate", str(directory), "--output", str(tmp_path / "out")])
    told = capsys.readouterr().err
    assert f"{tmp_path / 'out'}: Read-only file system; choose a place" in told
    assert not list((tmp_path / "out").iterdir())


def test_an_option_may_stand_several_times(tiny_recipe: Recipe) -> None:
    """With numbers as calculators write them, which begin like options."""
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    options = ["--l1", "off", "--episodes", "1", "--policy", "stochastic"]
    main(["evaluate", str(directory), *options, "--bias", "-1e-1", "--gain", "0.5", "--bias", "2"])
    rows = rows_of(directory / "evaluation" / "evaluation.csv")
    tested = [(float(row["bias"]), float(row["gain"])) for row in rows]
    assert tested == [(-0.1, 1.0), (2.0, 1.0), (0.0, 0.5)]


def test_pictures_of_another_evaluation_do_not_stay(tiny_recipe: Recipe, tmp_path: Path) -> None:
    directory, output = run(tiny_recipe("l1=off", "outer_iterations=1")), tmp_path / "out"
    output.mkdir()
    for name in ("returns.png", "recovered.png", "robustness.png", "filmstrip.png", "mine.png"):
        (output / name).write_text("of another one")
    options = ["--l1", "off", "--episodes", "1", "--output", str(output)]
    main(["evaluate", str(directory), *options])
    assert {file.name for file in output.glob("*.png")} == {"robustness.png", "mine.png"}
    assert matplotlib.image.imread(output / "robustness.png").std() > 0


def test_a_path_that_is_no_utf8_costs_no_evaluation(tiny_recipe: Recipe, tmp_path: Path) -> None:
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    try:
        moved = directory.rename(tmp_path / os.fsdecode(b"caf\xe9"))
    except OSError:
        pytest.skip("the file system takes no such name")
    main(["evaluate", str(moved), "--l1", "off", "--episodes", "1"])
    rows = rows_of(moved / "evaluation" / "evaluation.csv")
    assert {row["run"] for row in rows} == {str(tmp_path / "caf\\udce9")}
    assert all(float(row["return_mean"]) < 0 for row in rows)


def test_a_copy_of_a_run_is_no_second_seed(
    tiny_recipe: Recipe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    shutil.copytree(directory, tmp_path / "copy")
    with pytest.raises(SystemExit):
        main(["evaluate", str(directory), str(tmp_path / "copy"), "--episodes", "1"])
    assert "are both of seed 0, one training and no two" in capsys.readouterr().err


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


def test_settings_that_look_like_interpolations_are_what_they_were(tiny_recipe: Recipe) -> None:
    words = ["a ${x}", r"b \${y} \\${z}", "${oc.env:HOME}", r"\d"]
    trained = run(tiny_recipe())
    file = trained / "config.yaml"
    config = yaml.safe_load(file.read_text())
    config["wandb"]["tags"] = words
    file.write_text(yaml.safe_dump(config))
    assert load_run(trained).recipe.wandb.tags == words


def test_epsilon_zero_moves_the_operating_point_in_every_step(tiny_recipe: Recipe) -> None:
    trained = load_run(run(tiny_recipe("l1=off")))
    (row,) = evaluate(trained, [Condition("paper", epsilon=0.0)], 2)
    assert row["l1/switch_rate"] > 0.5
    assert row["epsilon"] == 0.0


def test_single_episodes_stand_beside_the_means(tiny_recipe: Recipe) -> None:
    trained = load_run(run(tiny_recipe()))
    cells = [Condition("off"), Condition("off", disturbances={"bias": 2.0}), Condition("oracle")]
    tests = list(evaluate_episodes(trained, cells, 3))
    assert [row for row, _ in tests] == list(evaluate(trained, cells, 3))
    for row, episodes in tests:
        assert [one["episode"] for one in episodes] == [0, 1, 2]
        assert sum(one["return"] for one in episodes) / 3 == pytest.approx(row["return_mean"])
        assert {one["steps"] for one in episodes} == {row["steps_mean"]} == {15}
        assert all(
            one[key] == row[key] for one in episodes for key in cells[0].columns() if key != "stage"
        )
    # Without a disturbance there is nothing that the oracle could undo.
    plain, biased, oracle = ([one["return"] for one in episodes] for _, episodes in tests)
    assert plain == oracle != biased


def test_the_oracle_undoes_a_bias_and_is_nobodys_own_controller(tiny_recipe: Recipe) -> None:
    trained = load_run(run(tiny_recipe("l1=paper")))
    cells = [
        Condition(l1, disturbances={"bias": bias}, policy="deterministic")
        for l1, bias in (("off", 0.0), ("off", 0.5), ("oracle", 0.5))
    ]
    undisturbed, lost, kept = evaluate(trained, cells, 4)
    assert kept["return_mean"] == pytest.approx(undisturbed["return_mean"], rel=1e-3)
    assert lost["return_mean"] != pytest.approx(undisturbed["return_mean"], rel=1e-2)
    assert kept["own_l1"] == 0


def test_a_suite_ends_in_a_table_of_what_is_recovered(
    tiny_recipe: Recipe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(tiny_recipe("l1=off"))
    options = ["--suite", "quick", "--episodes", "3", "--policy", "deterministic"]
    main(["evaluate", str(directory), *options, "--output", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "inverted_pendulum: deterministic policy" in printed
    assert " L1 paper recovered |" in printed
    rows = rows_of(tmp_path / "out" / "evaluation.csv")
    idle = {"friction", "armature", "softness", "step"}  # no contacts, no rotors, no 50th step
    assert len(rows) == 4 * sum(idle.isdisjoint(cell) for cell in suite("quick"))
    episodes = rows_of(tmp_path / "out" / "episodes.csv")
    assert len(episodes) == 3 * len(rows)
    assert list(episodes[0])[:4] == ["run", "training_seed", "l1", "noise"]
    assert list(episodes[0])[-3:] == ["episode", "return", "steps"]
    summary = rows_of(tmp_path / "out" / "summary.csv")
    assert {row["recovered_policies"] for row in summary if row["l1"] == "paper"} == {"1"}
    for name in ("returns", "recovered"):
        if f"{name}.png" in printed:
            assert matplotlib.image.imread(tmp_path / "out" / f"{name}.png").std() > 0.05
    assert "returns.png" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "nowhere"], "holds no run"),
        (["evaluate", "nowhere", "--l1", "of"], "unknown l1 setting 'of'; there are off, paper"),
        (["evaluate", "nowhere", "--noise", "loud"], "unknown noise setting"),
        (["evaluate", "nowhere", "--episodes", "0"], "--episodes must be positive"),
        (["evaluate", "nowhere", "--epsilon", "1", "-1"], "--epsilon must be finite and not neg"),
        (["evaluate", "nowhere", "--epsilon", "inf"], "--epsilon must be finite and not negative"),
        (["evaluate", "nowhere", "--suite", "loud"], "argument --suite: invalid choice"),
        (["evaluate", "nowhere", "--suite", "full", "--bias", "1"], "--suite and --bias both say"),
        (["evaluate", "nowhere", "--suite", "full", "--filmstrip"], "in place of --suite"),
        (["evaluate", "nowhere", "--alpha", "0.1", "1.5"], "--alpha must be above 0 and at most 1"),
        (["evaluate", "nowhere", "--alpha", "nan"], "--alpha must be above 0 and at most 1"),
        (["evaluate", "nowhere", "--bias", "0", "inf"], "--bias must be finite, got inf"),
        (["evaluate", "nowhere", "--gain", "weak"], "argument --gain: invalid float value"),
        (["evaluate", "nowhere", "--dropout", "0", "2"], "--dropout: SensorDropout: a probability"),
        (["evaluate", "nowhere", "--mass", "-1"], "--mass: mass must be positive, got -1.0"),
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


def test_values_that_a_controller_has_not_are_refused_before_the_work(
    tiny_recipe: Recipe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    options = ["--l1", "off", "robust", "--alpha", "0.1", "--output", str(tmp_path / "out")]
    with pytest.raises(SystemExit):
        main(["evaluate", str(directory), *options])
    assert "none of off, robust has a low-pass filter" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="L1 robust"):
        next(evaluate(load_run(directory), [Condition("robust", alpha=0.1)], 1))


def test_typo_in_an_override_fails_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        main(["run", "metrpo/inverted_pendulum", "sed=3"])
    assert exit_info.value.code != 0
    assert "sed" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


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


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as handle:
        return list(csv.DictReader(handle))


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
        assert "no stage 'fine_tuning', or not yet; there are shooting, cloning" in error
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


def test_rows_of_a_single_stage_are_as_they_were(tiny_recipe: Callable[..., DictConfig]) -> None:
    loaded = load_run(run(tiny_recipe("outer_iterations=1")))
    cell = Condition("off")
    (row,) = evaluate(loaded, [cell], 2)
    assert "stage" not in row
    with pytest.raises(ValueError, match="no stage 'shooting', or not yet; there is policy"):
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
