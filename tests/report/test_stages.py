"""Reports over runs with several stages."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.stats import t

from torchrl_l1.algorithms import MBMF
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.report import curves, evaluation_figures, report
from torchrl_l1.report.curves import plot_task
from torchrl_l1.report.evaluations import evaluation_rows
from torchrl_l1.report.identity import facts
from torchrl_l1.report.runs import find_readable_runs, find_runs
from torchrl_l1.report.stages import plot_stages, stage_rows
from torchrl_l1.report.study import Study, studies
from torchrl_l1.report.training import time_rows, time_table, training_row

WriteRun = Callable[..., Path]

RNG = np.random.default_rng(0)
PENDULUM = "mbmf/inverted_pendulum"
STAGE = [1] * 4 + [2] * 3 + [3] * 5
STEPS = [2000, 3000, 4000, 5000, 5000, 6700, 8400, 12400, 16400, 20400, 24400, 28400]
# What L1 adds at the end of each stage.
GAIN = {1: 6.0, 2: 3.0, 3: 0.5}


def returns_of(seed: int, arm: str = "off") -> np.ndarray:
    """Nearly the same for all seeds, and better with L1, stage by stage."""
    base = np.array([-90, -30, -20, -10, -14, -12, -11, -9, -8, -7, -6, -5.0])
    base = base - 0.1 * seed
    if arm != "off":
        base += [GAIN[stage] + 0.01 * seed for stage in STAGE]
    return base


def frozen(*stages: str, policies: tuple[str, ...] = ("stochastic",)) -> list[dict[str, Any]]:
    return [
        {"l1": l1, "noise": "none", "bias": bias, "gain": 1.0, "policy": policy, "episodes": 5,
         "return_mean": -(1 + stages.index(stage)) * (9 if l1 == "off" else 1) * (1 + bias),
         "stage": stage}
        for stage in stages
        for policy in policies
        for bias in (0.0, 1.0)
        for l1 in ("off", "paper")
    ]  # fmt: skip


@pytest.fixture
def write_mbmf(write_run: WriteRun) -> WriteRun:
    def write(seed: int, arm: str = "off", *overrides: str, done: int = 12, **options: Any) -> Path:
        returns = returns_of(seed, arm)
        mean_action = returns + (np.array(STAGE) == 3)
        switches = [0.02 if stage == 1 and arm != "off" else None for stage in STAGE]
        columns: dict[str, Any] = {"real_steps": STEPS, "stage": STAGE, "l1/switch_rate": switches}
        columns |= options.pop("columns", {})
        phases = {1: {"fit": 4.0, "collect": 6.0}, 2: {"clone": 3.0}, 3: {"tune": 1.0}}
        rest = dict.fromkeys(("random", "fit", "clone", "tune", "collect", "evaluate"), 0.0)
        timings = [
            {"iteration": i, **rest, **phases[stage]} for i, stage in enumerate(STAGE[:done])
        ]
        return write_run(
            returns[:done], f"l1={arm}", *overrides, recipe=PENDULUM, seed=seed, iterations=12,
            timings=timings, signals=columns, deterministic=mean_action.tolist(), **options,
        )  # fmt: skip

    return write


def study(tmp_path: Path) -> Study:
    (found,) = studies(find_runs([tmp_path / "runs"]))
    return found


def test_return_of_a_stage_is_that_of_its_last_iterations(
    write_mbmf: WriteRun, tmp_path: Path
) -> None:
    for arm in ("off", "paper"):
        for seed in range(3):
            write_mbmf(seed, arm)
    every = stage_rows(study(tmp_path))
    kinds = [("shooting", ""), ("cloning", "deterministic")]
    kinds += [("fine_tuning", "stochastic"), ("fine_tuning", "deterministic")]
    assert [(row["stage"], row["policy"]) for row in every] == 2 * kinds
    rows = {(r["l1"], r["stage"]): r for r in every if r["policy"] != "deterministic"}
    rows |= {(r["l1"], r["stage"]): r for r in every if r["stage"] == "cloning"}
    # Three iterations of the first and third stage, the last of the second.
    expected = {"shooting": -20.0, "cloning": -11.0, "fine_tuning": -6.0}
    for name, value in expected.items():
        row = rows["off", name]
        assert row["return_mean"] == pytest.approx(value - 0.1)
        assert row["std"] == pytest.approx(0.1 * np.std([0, 1, 2]))
        half = t.ppf(0.975, 2) * 0.1 / 3**0.5
        assert row["return_high"] - row["return_mean"] == pytest.approx(half)
        assert "difference_mean" not in row
    assert [rows["off", name]["real_steps"] for name in expected] == [5000, 8400, 28400]
    for stage, name in enumerate(expected, start=1):
        row = rows["paper", name]
        assert row["difference_mean"] == pytest.approx(GAIN[stage] + 0.01)
        half = t.ppf(0.975, 2) * 0.01 / 3**0.5
        assert row["difference_low"] == pytest.approx(row["difference_mean"] - half)
        assert row["pairs"] == 3
    # L1 acts in the first stage alone.
    assert rows["paper", "shooting"]["switches_per_1000"] == pytest.approx(20)
    assert "switches_per_1000" not in rows["paper", "fine_tuning"]


def test_last_stage_is_the_return_of_the_training(write_mbmf: WriteRun, tmp_path: Path) -> None:
    write_mbmf(0)
    found = study(tmp_path)
    ((cell, runs),) = found.cells.items()
    sampled, mean_action = stage_rows(found)[-2:]
    row = training_row(cell, runs)
    assert sampled["return_mean"] == row["return_mean"]
    assert mean_action["return_mean"] == row["deterministic_mean"] == row["return_mean"] + 1


@pytest.mark.parametrize(
    ("stages", "expected"),
    [([1] * 4 + [2] * 6 + [3] * 2, 2), ([1] * 4 + [2] * 7 + [3], 1), ([1] * 4 + [2] * 8, 1)],
)
def test_return_of_the_training_is_of_the_last_stage_alone(
    write_mbmf: WriteRun, tmp_path: Path, stages: list[int], expected: int
) -> None:
    """The last of them, as under Stages: two, one, and of cloning the last round."""
    curves = RNG.normal(-50, 20, (2, 12))
    for seed, curve in enumerate(curves):
        columns = {"stage": stages, "return_mean": curve, "return_deterministic": curve + 1}
        write_mbmf(seed, columns=columns)
    found = study(tmp_path)
    ((cell, runs),) = found.cells.items()
    row = training_row(cell, runs)
    last = curves[:, -expected:]
    assert row["return_mean"] == pytest.approx(last.mean())
    assert row["deterministic_mean"] == pytest.approx(last.mean() + 1)
    assert row["published_spread"] == pytest.approx(last.std(axis=0).mean())
    assert stage_rows(found)[-1]["return_mean"] == pytest.approx(last.mean() + 1)


def test_unfinished_and_unpaired_runs_enter_no_difference(
    write_mbmf: WriteRun, tmp_path: Path
) -> None:
    write_mbmf(0)
    write_mbmf(0, "paper")
    write_mbmf(1, done=9)
    write_mbmf(1, "paper")
    write_mbmf(2, "paper", done=9)
    rows = [row for row in stage_rows(study(tmp_path)) if row["stage"] == "cloning"]
    off, paper = rows
    assert (off["seeds"], paper["seeds"], paper["pairs"]) == (1, 2, 1)
    assert paper["without_pair"] == "1 2"


@pytest.mark.parametrize("stage", [[1, 1, 3] + [3] * 9, [2] * 12, [1] * 6 + [2] * 3 + [1] * 3])
def test_stages_out_of_turn_are_refused(
    stage: list[int], write_mbmf: WriteRun, tmp_path: Path
) -> None:
    write_mbmf(0, columns={"stage": stage})
    with pytest.raises(RunDirectoryError, match="the stages are not 1 to 3 in turn"):
        find_readable_runs([tmp_path / "runs"])


def test_missing_stage_is_named(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([-1, -2], recipe=PENDULUM)
    with pytest.raises(RunDirectoryError, match="has no column stage"):
        find_readable_runs([tmp_path / "runs"])


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Figure]:
    figures: dict[str, Figure] = {}
    for module in (curves, evaluation_figures):
        save = module.save
        monkeypatch.setattr(
            module,
            "save",
            lambda figure, file, save=save: (
                figures.update({file.stem: figure}),
                save(figure, file),
            )[1],
        )
    return figures


def test_boundaries_are_marked_and_each_stage_has_a_panel(
    write_mbmf: WriteRun, tmp_path: Path, drawn: dict[str, Figure]
) -> None:
    for arm in ("off", "paper"):
        write_mbmf(0, arm)
    found = study(tmp_path)
    plot_task(found, "inverted_pendulum", tmp_path / "curves.png")
    (axis,) = drawn["curves"].axes
    bands = {patch.get_label(): patch for patch in axis.patches}
    edges = {name: (p.get_x(), p.get_x() + p.get_width()) for name, p in bands.items()}
    assert edges == {
        "random shooting": (0, pytest.approx(5.0)),
        "cloning": (5.0, pytest.approx(8.4)),
    }
    (legend,) = drawn["curves"].legends
    words = [text.get_text() for text in legend.get_texts()]
    assert words[-2:] == ["random shooting", "cloning"]
    plot_stages(found, "inverted_pendulum", tmp_path / "stages.png")
    panels = drawn["stages"].axes
    titles = [axis.get_title() for axis in panels]
    assert [name.split(": ")[1] for name in titles] == ["random shooting", "cloning", "fine-tuning"]
    for axis, stage in zip(panels, (1, 2, 3), strict=True):
        chosen = [i for i, number in enumerate(STAGE) if number == stage]
        bold = next(line for line in axis.lines if line.get_label() == "L1 off")
        assert list(bold.get_xdata() * 1000) == pytest.approx([STEPS[i] for i in chosen])
        assert list(bold.get_ydata()) == pytest.approx(returns_of(0)[chosen])
        assert not axis.patches
    assert len({axis.get_ylim() for axis in panels}) == 1


@pytest.mark.parametrize(("done", "shaded"), [(2, 1), (5, 2), (9, 2)])
def test_stages_of_an_unfinished_run_are_marked_up_to_the_last(
    write_mbmf: WriteRun, tmp_path: Path, drawn: dict[str, Figure], done: int, shaded: int
) -> None:
    write_mbmf(0, done=done)
    plot_task(study(tmp_path), "inverted_pendulum", tmp_path / "curves.png")
    (axis,) = drawn["curves"].axes
    names = ["random shooting", "cloning"][:shaded]
    assert [patch.get_label() for patch in axis.patches] == names
    ends = [patch.get_x() + patch.get_width() for patch in axis.patches]
    last = [max(STEPS[i] for i in range(done) if STAGE[i] == s + 1) for s in range(shaded)]
    assert [1000 * end for end in ends] == pytest.approx(last)


def test_mean_action_has_a_curve_in_fine_tuning_only(
    write_mbmf: WriteRun, tmp_path: Path, drawn: dict[str, Figure]
) -> None:
    write_mbmf(0)
    found = study(tmp_path)
    plot_task(found, "inverted_pendulum", tmp_path / "curves.png")
    plot_stages(found, "inverted_pendulum", tmp_path / "stages.png")
    last = [i for i, stage in enumerate(STAGE) if stage == 3]
    for axis in (*drawn["curves"].axes, *drawn["stages"].axes):
        drawn_lines = [line for line in axis.lines if len(line.get_xdata())]
        dashed = [line for line in drawn_lines if line.get_linestyle() == "--"]
        if axis.get_title().endswith(("shooting", ": cloning")):
            assert not dashed
        else:
            (line,) = dashed
            assert list(1000 * line.get_xdata()) == pytest.approx([STEPS[i] for i in last])
            assert list(line.get_ydata()) == pytest.approx(returns_of(0)[last] + 1)
    page = report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "dashed: mean of the return with the mean action in fine-tuning; shaded:" in page


def test_unfinished_run_shows_the_stages_that_it_has_reached(
    write_mbmf: WriteRun, tmp_path: Path, drawn: dict[str, Figure]
) -> None:
    write_mbmf(0, done=5)
    plot_stages(study(tmp_path), "inverted_pendulum", tmp_path / "stages.png")
    shooting, cloning = drawn["stages"].axes
    assert len(shooting.lines[0].get_xdata()) == 4
    # A single point makes no line.
    assert cloning.lines[0].get_marker() == "o"


def test_frozen_stages_are_rows_and_panels(
    write_mbmf: WriteRun, tmp_path: Path, drawn: dict[str, Figure]
) -> None:
    both = ("stochastic", "deterministic")
    tests = frozen("shooting", "fine_tuning", policies=both)
    for seed in range(3):
        write_mbmf(seed, evaluations={"shooting_frozen": tests, "disturbances": tests})
    rows = evaluation_rows(study(tmp_path), "disturbances")
    keys = [(row["stage"], row["policy"], row["bias"], row["l1"]) for row in rows]
    # Planners act in one way.
    assert len(keys) == len(set(keys)) == 4 + 2 * 4
    assert {policy for stage, policy, *_ in keys if stage == "shooting"} == {"stochastic"}
    assert [key[0] for key in keys] == ["shooting"] * 4 + ["fine_tuning"] * 8
    means = {key: row["return_mean"] for key, row in zip(keys, rows, strict=True)}
    assert means["shooting", "stochastic", 1.0, "off"] == -18
    assert means["fine_tuning", "deterministic", 1.0, "paper"] == -4
    assert rows[1]["difference_mean"] == 8
    page = report([tmp_path / "runs"], tmp_path / "out").read_text()
    titles = {
        name.partition("_none_off_")[2]: [axis.get_title() for axis in figure.axes]
        for name, figure in drawn.items()
        if name.startswith("disturbances")
    }
    assert titles == {
        "shooting": ["random shooting"] * 2,
        "fine_tuning": ["fine-tuning, sampled actions"] * 2 + ["fine-tuning, mean action"] * 2,
    }
    assert "trained with no noise and L1 off, stage shooting](disturbances_" in page
    section = page.split("## Evaluation `shooting_frozen`")[1].split("\n## ")[0]
    planned, sampled, mean_action = re.split(r"Trained with L1 off", section)[1:]
    starts = (":", ", sampled actions:", ", mean action:")
    for table, start in zip((planned, sampled, mean_action), starts, strict=True):
        assert table.startswith(start)
        stage = "shooting" if start == ":" else "fine_tuning"
        lines = [line for line in table.splitlines() if "inverted" in line]
        assert [line.split(" | ")[1] for line in lines] == [stage] * 2
    with (tmp_path / "out/shooting_frozen.csv").open() as file:
        assert [row["stage"] for row in csv.DictReader(file)] == [key[0] for key in keys]
    # The paper's table is of the training's own returns.
    assert "| -100.5 ± 4.3" not in section


def test_ablation_tells_planners_from_policies(write_mbmf: WriteRun, tmp_path: Path) -> None:
    tests = frozen("shooting", "fine_tuning", policies=("stochastic", "deterministic"))
    for arm in ("off", "paper"):
        write_mbmf(0, arm, evaluations={"ablation": tests})
    page = report([tmp_path / "runs"], tmp_path / "out").read_text()
    section = page.split("\n## Ablation\n")[1].split("\n## ")[0]
    tables = re.findall(r"^L1 paper(.*):\n\n((?:\|.*\n)+)", section, re.MULTILINE)
    found = [
        (words, [name for name in MBMF.facts.stage_names if f"| {name} |" in text])
        for words, text in tables
    ]
    assert found == [
        ("", ["shooting"]),
        (", sampled actions", ["fine_tuning"]),
        (", mean action", ["fine_tuning"]),
    ]


def test_planner_alone_is_not_said_to_sample(write_mbmf: WriteRun, tmp_path: Path) -> None:
    write_mbmf(0, evaluations={"shooting_frozen": frozen("shooting")})
    page = report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "Trained with L1 off:" in page


def test_tests_without_a_stage_have_no_such_column(write_mbmf: WriteRun, tmp_path: Path) -> None:
    tests = [{k: v for k, v in row.items() if k != "stage"} for row in frozen("fine_tuning")]
    write_mbmf(0, evaluations={"e": tests})
    assert all("stage" not in row for row in evaluation_rows(study(tmp_path), "e"))


def test_time_is_told_stage_by_stage(write_mbmf: WriteRun, tmp_path: Path) -> None:
    for seed in range(2):
        write_mbmf(seed)
    rows = {row["stage"]: row for row in time_rows(study(tmp_path))}
    assert {k: rows["shooting"][k] for k in ("fit", "collect", "clone", "runs")} == {
        "fit": 4.0, "collect": 6.0, "clone": 0.0, "runs": 2,
    }  # fmt: skip
    assert rows["fine_tuning"]["tune"] == 1.0
    # 4 x 10 s, 3 x 3 s, 5 x 1 s.
    assert [rows[s]["share"] for s in ("shooting", "cloning", "fine_tuning")] == [
        pytest.approx(seconds / 54) for seconds in (40, 9, 5)
    ]
    assert rows["shooting"]["ms_per_step"] == pytest.approx(40_000 / 5000)
    assert rows["cloning"]["ms_per_step"] == pytest.approx(9000 / 3400)
    assert "| stage |" in time_table(list(rows.values()), facts("mbmf")).splitlines()[0]


def test_report_puts_table_4_beside_the_returns_and_has_the_stages(
    write_mbmf: WriteRun, tmp_path: Path
) -> None:
    for noise in ("none", "action"):
        for arm in ("off", "paper"):
            for seed in range(3):
                write_mbmf(seed, arm, f"noise={noise}")
    out = tmp_path / "out"
    page = report([tmp_path / "runs"], out).read_text()
    assert "The algorithm is MBMF." in page
    training = page.split("## Training")[1].split("\n## ")[0]
    for cell in ("-100.5 ± 4.3", "-10.5 ± 3.7", "-7.4 ± 1.5", "-4.8 ± 1.9"):
        assert cell in training
    assert "authors" not in page
    stages = page.split("## Stages")[1].split("\n## ")[0]
    header, _, *lines = [line for line in stages.splitlines() if line.startswith("|")]
    columns = [cell.strip() for cell in header.strip("|").split("|")]
    assert columns == [
        "task", "noise", "stage", "policy", "real steps", "L1 off", "L1 paper", "L1 paper less off",
        "seeds", "switches per 1000 steps",
    ]  # fmt: skip
    assert len(lines) == 2 * 4
    assert "3.01 [2.99, 3.03]" in lines[1]
    with (out / "stages.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * 2 * 4
    for name in ("stages_inverted_pendulum.png", "learning_curves_inverted_pendulum.png"):
        assert f"({name})" in page
        assert matplotlib.image.imread(out / name).std() > 0.05
