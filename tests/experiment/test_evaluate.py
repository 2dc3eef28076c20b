from __future__ import annotations

import csv
import errno
import io
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import pytest
import yaml
from omegaconf import DictConfig

from torchrl_l1.cli import evaluate as evaluate_command
from torchrl_l1.cli import main
from torchrl_l1.experiment.evaluate import evaluate, evaluate_episodes, load_run
from torchrl_l1.experiment.matrix import Condition, suite
from torchrl_l1.experiment.run import run

from .conftest import rows_of

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
    pictures = ("returns.png", "recovered.png", "robustness.png", "filmstrip.png", "mine.png")
    for name in (*pictures, "evaluation.csv"):
        (output / name).write_text("of another one")
    options = ["--l1", "off", "--episodes", "1", "--output", str(output)]
    main(["evaluate", str(directory), *options])
    assert {file.name for file in output.glob("*.png")} == {"robustness.png", "mine.png"}
    assert matplotlib.image.imread(output / "robustness.png").std() > 0


def test_files_of_no_evaluation_are_neither_deleted_nor_replaced(
    tiny_recipe: Recipe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(tiny_recipe("l1=off", "outer_iterations=1"))
    for name in ("filmstrip.png", "summary.csv"):
        file = tmp_path / f"with {name}" / name
        file.parent.mkdir()
        file.write_text("mine")
        options = ["--l1", "off", "--episodes", "1", "--output", str(file.parent)]
        with pytest.raises(SystemExit):
            main(["evaluate", str(directory), *options])
        assert f"{file} already exists" in capsys.readouterr().err
        assert file.read_text() == "mine" and list(file.parent.iterdir()) == [file]


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
    assert "are both of seed 0, so they are one training" in capsys.readouterr().err


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
        (["evaluate", "nowhere", "--suite", "full", "--bias", "1"], "--suite and --bias both set"),
        (["evaluate", "nowhere", "--suite", "full", "--filmstrip"], "instead of giving --suite"),
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
