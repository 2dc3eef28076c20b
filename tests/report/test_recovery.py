"""Recovered: columns, tables and heat maps."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.report import recovery, report
from torchrl_l1.report.evaluation_summary import summarize, summary_lines, summary_tables
from torchrl_l1.report.evaluations import ablation_rows, evaluation_rows
from torchrl_l1.report.identity import facts
from torchrl_l1.report.reading import read_evaluations
from torchrl_l1.report.recovery import (
    RETURNS,
    SHARES,
    disturbance_cells,
    is_about_robustness,
    plot_heat_map,
    recovery_columns,
    robustness_table,
    varied,
)
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import Study

from .conftest import write_rows

WriteRun = Callable[..., Path]
METRPO = facts("metrpo")
CONTROLLERS = {"off": 0.0, "paper": 0.75, "oracle": 1.0}


def returns(bias: float, l1: str, seed: int) -> list[float]:
    """What the disturbance takes, less the share that the controller gives back."""
    start = np.random.default_rng(seed).normal(0.0, 1.0, 6)
    return list(start - 100 * bias * (1 - CONTROLLERS[l1]))


def conditions_and_episodes(seed: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    tests, episodes = [], []
    for bias in (0.0, 0.5, 1.0):
        for l1 in CONTROLLERS:
            place = {"l1": l1, "noise": "none", "bias": bias, "gain": 1.0, "policy": "stochastic"}
            place |= {"epsilon": None, "alpha": None}
            mine = returns(bias, l1, seed)
            steps = 90 - 40 * (bias == 1 and l1 == "off")
            mean = {"return_mean": float(np.mean(mine)), "episodes": 6, "steps_mean": steps}
            tests.append(place | mean)
            numbered = {"run": f"run_{seed}", "training_seed": seed}
            episodes += [
                numbered | place | {"episode": i, "return": value, "steps": steps}
                for i, value in enumerate(mine)
            ]
    return tests, episodes


def written(write_run: WriteRun, seeds: int) -> None:
    for seed in range(seeds):
        tests, episodes = conditions_and_episodes(seed)
        path = write_run([1.0], "l1=off", seed=seed, evaluations={"robustness": tests})
        write_rows(path / "evaluations" / "episodes" / "robustness.csv", episodes)


def test_policies_are_paired_and_the_others_left_out() -> None:
    off, oracle = {"a": [0.0, 1.0], "b": [0.0, 2.0], "c": [9.0]}, {"a": [4.0, 5.0], "b": [4.0, 6.0]}
    on = {"a": [1.0, 2.0], "b": [1.0, 3.0], "c": [9.0]}
    columns = recovery_columns(off, on, oracle)
    assert (columns["gap"], columns["recovered"]) == pytest.approx((4, 0.25))
    assert columns["recovered_policies"] == 2
    assert recovery_columns(off, on, {}) == recovery_columns({}, on, oracle) == {}
    assert recovery_columns({"a": [1.0]}, {"a": [1.0]}, {"a": [1.0, 2.0]}) == {}
    equal = recovery_columns(off, on, off)
    assert equal["gap"] == 0 and "recovered" not in equal


def test_single_episodes_are_read_beside_their_table(write_run: WriteRun, tmp_path: Path) -> None:
    written(write_run, 1)
    (file,) = tmp_path.glob("runs/*/evaluations/robustness.csv")
    for test in read_evaluations(file):
        assert list(test.returns) == pytest.approx(returns(test.disturbances["bias"], test.l1, 0))
        assert test.steps_mean in (50, 90)
    (file.parent / "episodes" / "robustness.csv").unlink()
    assert {test.returns for test in read_evaluations(file)} == {()}


def test_report_says_what_is_recovered(write_run: WriteRun, tmp_path: Path) -> None:
    written(write_run, 3)
    page = report([tmp_path / "runs"])
    section = page.read_text().split("\n## Robustness\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    columns = [cell.strip() for cell in lines[0].strip("|").split("|")]
    assert columns == [
        *("disturbance", "training seeds", "L1 off", "L1 paper", "oracle", "oracle less off"),
        "L1 paper recovered",
    ]
    undisturbed, half, whole = ([c.strip() for c in one.strip("|").split("|")] for one in lines[2:])
    assert (undisturbed[0], undisturbed[-1]) == ("undisturbed", "–")
    assert (half[0], half[-1], whole[-1]) == ("bias 0.5", "0.75 [0.75, 0.75]", "0.75 [0.75, 0.75]")
    # Episodes that end early say so.
    assert whole[2].endswith(", 50 steps") and whole[3].endswith(", 90 steps")
    assert "one training seed" not in section
    pictures = {file.name for file in page.parent.glob("*.png")}
    assert {
        f"{what}_robustness_inverted_pendulum_none_off.png" for what in ("returns", "recovered")
    } <= pictures
    with (page.parent / "robustness.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    shares = {(row["l1"], row["bias"]): row["recovered"] for row in rows}
    assert float(shares["paper", "1.0"]) == pytest.approx(0.75)
    assert shares["off", "1.0"] == shares["oracle", "1.0"] == shares["paper", "0.0"] == ""


def test_one_policy_is_told_apart(write_run: WriteRun, tmp_path: Path) -> None:
    written(write_run, 1)
    assert "over its episodes alone" in report([tmp_path / "runs"]).read_text()
    rows, episodes = conditions_and_episodes(0)
    text = summary_tables(summarize(rows, episodes))
    assert "over the episodes of this one policy alone" in text
    assert " 0.75 [0.75, 0.75] |" in text
    assert "recovered" not in summary_tables(summarize(rows))


def test_the_oracle_is_no_arm_of_the_ablation(write_run: WriteRun, tmp_path: Path) -> None:
    tests, _ = conditions_and_episodes(0)
    write_run([1.0], "l1=off", evaluations={"ablation": tests})
    rows = evaluation_rows(Study(find_runs([tmp_path])), "ablation")
    assert [row["l1"] for row in rows[:3]] == ["off", "paper", "oracle"]
    assert [row["l1"] for row in ablation_rows(rows)] == ["off", "paper"]


def row(l1: str, value: float, share: float | None = None, **values: Any) -> dict[str, Any]:
    found = {"l1": l1, "noise": "none", "bias": 0.0, "gain": 1.0, "policy": "stochastic"}
    found |= {"return_mean": value, "training_seeds": 1, "std": 0.0}
    return found | ({} if share is None else {"recovered": share}) | values


def test_heat_map_has_a_number_in_each_cell_that_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    save = recovery.save
    monkeypatch.setattr(
        recovery, "save", lambda figure, file: (drawn.append(figure), save(figure, file))[1]
    )
    rows = [
        row("oracle", -0.1, gain=0.5), row("off", -50.0, gain=0.5),
        row("paper", -20.0, 0.6, gain=0.5), row("slow", -30.0, 0.4, gain=0.5),
        row("off", -0.1), row("oracle", -0.1), row("paper", -0.1), row("slow", -0.2),
        row("paper", -70.0, -1.5, bias=1.0, gap=-2.0),
    ]  # fmt: skip
    assert plot_heat_map(rows, SHARES, "Task", tmp_path / "a.png", METRPO) == tmp_path / "a.png"
    assert plot_heat_map(rows, RETURNS, "Task", tmp_path / "b.png", METRPO) == tmp_path / "b.png"
    (shares,), (values,) = (figure.axes for figure in drawn)
    for axis, tested in ((shares, 2), (values, 4)):
        lines = [label.get_text() for label in axis.get_yticklabels()]
        assert lines == ["undisturbed", "bias 1", "gain 0.5"]
        names = [label.get_text() for label in axis.get_xticklabels()]
        assert len(names) == tested
    assert names[-1] == "oracle" and set(names[:-1]) == {"L1\noff", "L1\npaper", "L1\nslow"}
    written = {
        (round(t.get_position()[0]), round(t.get_position()[1])): t.get_text() for t in shares.texts
    }
    assert written == {(0, 2): "0.60", (1, 2): "0.40", (0, 1): "-1.50*"}
    assert len(values.texts) == len(rows)
    assert plot_heat_map(rows[4:8], SHARES, "Task", tmp_path / "c.png", METRPO) is None
    assert not (tmp_path / "c.png").exists()


def test_many_disturbances_share_a_column(monkeypatch: pytest.MonkeyPatch) -> None:
    lag = replace(DISTURBANCES["bias"], name="lag", setting="lag")
    monkeypatch.setitem(DISTURBANCES, "lag", lag)
    rows = [row("off", 1.0, lag=0.0), *(row("off", 1.0, **{n: 2.0}) for n in ("bias", "gain"))]
    assert varied(rows) == ["bias", "gain"] and not is_about_robustness(rows)
    assert disturbance_cells(rows[1], varied(rows)) == {"bias": "2", "gain": ""}
    rows.append(row("off", 1.0, lag=3.0))
    assert is_about_robustness(rows)
    cells = [disturbance_cells(one, varied(rows)) for one in rows]
    assert [cell["disturbance"] for cell in cells] == ["", "bias 2", "gain 2", "lag 3"]
    summary = summarize([one | {"episodes": 1} for one in rows])
    assert [line["disturbance"] for line in summary_lines(summary)] == [
        *("undisturbed", "bias 2", "gain 2", "lag 3"),
    ]


def test_lines_go_by_disturbance_and_controllers_end_with_the_oracle() -> None:
    rows = [row(l1, 1.0, gain=gain) for gain in (0.5, 1.0) for l1 in ("oracle", "off", "paper")]
    table = robustness_table(rows).splitlines()
    assert table[0].startswith("| disturbance | training seeds | L1 off | L1 paper | oracle |")
    assert [line.split("|")[1].strip() for line in table[2:]] == ["undisturbed", "gain 0.5"]


def test_what_the_oracle_gains_is_of_as_many_policies_as_there_are() -> None:
    def gap(value: float, policies: int) -> dict[str, Any]:
        limits = {"gap_low": value - 1, "gap_high": value + 1}
        return {"gap": value, **limits, "recovered_policies": policies}

    rows = [row("off", 1.0), row("paper", 2.0, **gap(7, 2)), row("robust", 3.0, **gap(5, 3))]
    header, _, line = (text.strip("| ") for text in robustness_table(rows).splitlines())
    assert header.endswith("oracle less off") and line.endswith("| 5 [4, 6]")
