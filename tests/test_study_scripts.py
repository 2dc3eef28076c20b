"""What the scripts of the studies make of the files that they read."""

from __future__ import annotations

import csv
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from scipy.stats import ttest_1samp

from tests.test_studies import RESULTS, ROOT, rows, script
from torchrl_l1.algorithms.collection import ORACLE, make_pipeline
from torchrl_l1.control import L1Config, kalman_law
from torchrl_l1.control.kalman import Posterior
from torchrl_l1.control.state import init
from torchrl_l1.envs import TASKS, Perturbation


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that would have been saved."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures


def test_the_sample_of_the_suite_is_its_resets(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = script("suite", monkeypatch)
    rng = np.random.default_rng(0)
    undisturbed, off, on = (rng.normal(mean, 1.0, 8) for mean in (10.0, 4.0, 8.0))
    # A second value at which the same comes of each reset says nothing new.
    cells = [("bias", 1.0), ("bias", 2.0)]
    returns = {("seed_0", "off", suite.NONE): undisturbed}
    for cell in cells:
        returns |= {("seed_0", "off", cell): off, ("seed_0", "robust", cell): on}
    mean, interval = suite.change(returns, "robust", cells)
    shares = (on - off) / undisturbed.mean()
    expected = ttest_1samp(shares, 0.0).confidence_interval()
    found = [mean, interval.low, interval.high]
    np.testing.assert_allclose(found, [shares.mean(), expected.low, expected.high])
    loss = undisturbed - off
    share, ends = suite.regained(returns, "robust", cells)
    assert share == pytest.approx((on - off).mean() / loss.mean())
    for end in (ends.low, ends.high):
        assert ttest_1samp(on - off - end * loss, 0.0).pvalue == pytest.approx(0.05)


def test_the_sample_of_the_suite_is_its_policies_if_there_are_three(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    suite = script("suite", monkeypatch)
    rng = np.random.default_rng(1)
    cell = ("bias", 1.0)
    # Policies gain more or less, each the same from all resets.
    gains = np.array([1.0, 2.0, 6.0])
    returns = {}
    for policy, gain in enumerate(gains):
        off = rng.normal(10.0, 1.0, 8)
        returns[f"seed_{policy}", "off", suite.NONE] = np.full(8, 20.0)
        returns |= {(f"seed_{policy}", "off", cell): off}
        returns |= {(f"seed_{policy}", "robust", cell): off + gain}
    _, interval = suite.change(returns, "robust", [cell])
    expected = ttest_1samp(gains / 20, 0.0).confidence_interval()
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high))
    share, _ = suite.regained(returns, "robust", [cell])
    assert share == pytest.approx(gains.mean() / suite.lost(returns, [cell]).mean())


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ([0.0, 0.1, -0.1, 0.0], "not touched"),
        ([0.7, -0.6, 0.2, -0.3], "not touched"),
        ([1.2, -0.8, 0.3, -0.4], "cannot tell"),
        ([-5.0, 4.0, 0.0, 1.0], "cannot tell"),
        ([-1.0, -1.1, -0.9, -1.0], "worse"),
        ([1.0, 1.1, 0.9, 1.0], "helped"),
    ],
)
def test_a_disturbance_is_not_touched_only_if_any_large_change_is_excluded(
    changes: list[float], word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = script("suite", monkeypatch)
    cell = ("bias", 1.0)
    returns = {("seed_0", "off", one): np.full(4, 10.0) for one in (suite.NONE, cell)}
    returns["seed_0", "robust", cell] = 10.0 + np.array(changes)
    # Of an undisturbed return of 10, 10 % is 1.
    if word not in ("worse", "helped"):
        low, high = ttest_1samp(changes, 0.0).confidence_interval()
        assert (word == "not touched") == (low >= -1 and high <= 1)
    assert suite.verdict(returns, "robust", [cell]) == word


def test_figure_of_the_suite_says_what_lies_beyond_its_colours(
    drawn: list[Figure], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = script("suite", monkeypatch)
    suite.plot({"walker": suite.read("walker")}, tmp_path / "verdicts.png")
    images = [axis.images[0] for axis in drawn[0].axes[:2]]
    assert min(image.get_array().min() for image in images) < images[-1].norm.vmin
    assert images[-1].colorbar.extend == "both"
    hatched = sum(bool(patch.get_hatch()) for axis in drawn[0].axes[:2] for patch in axis.patches)
    unknown = [row["walker (1)"] for row in rows((RESULTS / "suite/verdicts.md").read_text())][-1]
    assert hatched == sum(map(int, unknown.split(" / ")))
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["cannot tell"]


def test_no_model_lies_outside_the_figure(
    drawn: list[Figure], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit_quality = script("fit_quality", monkeypatch)
    with (RESULTS / "fit_quality/runs.csv").open(newline="") as handle:
        fit_quality.draw(list(csv.DictReader(handle)), tmp_path / "quality.png")
    for axis in drawn[0].axes:
        low, high = axis.get_xlim()
        for line in axis.lines[:2]:
            assert low < min(line.get_xdata()) and max(line.get_xdata()) < high


def biased(returns: dict[str, tuple[float, ...]], scatter: float = 1.0) -> list[dict[str, Any]]:
    """Episodes of a policy under each of two biases, by controller: 100 undisturbed."""
    resets = (-scatter, 0.0, scatter)
    return [
        {"run": "seed_0", "l1": l1, "noise": "none", "bias": bias, "signs": 0.0}
        | {"episode": float(episode), "return": (value if bias else 100.0) + reset}
        for l1, of in returns.items()
        for bias, value in zip((0.0, 0.2, -0.2), (0.0, *of), strict=True)
        for episode, reset in enumerate(resets)
    ]


def test_a_policy_recovers_a_share_of_what_certainly_costs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robust = script("robust", monkeypatch)
    returns = {"off": (50.0, 99.0), "paper": (45.0, 0.0), "robust": (80.0, 0.0)}
    # The second bias costs 1 % of 100, too little to speak of.
    [row] = robust.policy_rows(biased(returns | {"oracle": (90.0, 100.0)}))
    assert row["costly"] == [(0.2, 0.0)]
    assert row["share robust"][0] == pytest.approx(30 / 40)
    assert row["share paper"][0] == pytest.approx(-5 / 40)
    assert (row["off"], row["all robust"], row["undisturbed"]) == pytest.approx((50, 40, 100))
    # Of an oracle that is better at two resets of three nothing is certain.
    episodes = biased(returns | {"oracle": (90.0, 100.0)})
    for one in episodes:
        if (one["l1"], one["bias"]) == ("oracle", 0.2):
            one["return"] += (-80.0, 30.0, 50.0)[int(one["episode"])]
    [row] = robust.policy_rows(episodes)
    assert row["costly"] == [] and row["off"] is None
    line = robust.overall("task", [row])
    assert (line["of them with costly biases"], line["robust recovers"]) == ("0", "–")


def test_shares_have_fiellers_interval_over_resets(monkeypatch: pytest.MonkeyPatch) -> None:
    robust = script("robust", monkeypatch)
    rng = np.random.default_rng(0)
    episodes = biased({"off": (0, 0), "paper": (0, 0), "robust": (20, 30), "oracle": (40, 40)})
    for one in episodes:
        one["return"] += rng.normal()
    [row] = robust.policy_rows(episodes)
    of = {
        l1: np.mean(
            [[o["return"] for o in episodes if (o["l1"], o["bias"]) == (l1, bias)]
             for bias in (0.2, -0.2)], 0,
        )
        for l1 in ("off", "robust", "oracle")
    }  # fmt: skip
    _, ends = row["share robust"]
    for end in (ends.low, ends.high):
        # At its ends a t test of gain - share * gap just tells them apart.
        left = of["robust"] - of["off"] - end * (of["oracle"] - of["off"])
        assert ttest_1samp(left, 0.0).pvalue == pytest.approx(0.05)


def test_harm_is_that_of_the_mean_and_of_the_worst_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    robust = script("robust", monkeypatch)
    returns = {"good": {"off": 100.0, "paper": 80.0}, "bad": {"off": -60.0, "paper": -60.0}}
    scatter = (-3.0, 0.0, 6.0)
    episodes = [
        {"run": run, "l1": l1, "noise": "none", "bias": 0.0, "signs": 0.0, "episode": episode}
        | {"return": value + (scatter[episode] if l1 == "paper" else 0.0)}
        for run, of in returns.items()
        for l1, value in of.items()
        for episode in range(3)
    ]
    # -19 of 100, and 1 of 60.
    low, high = ttest_1samp([-23.0, -20.0, -14.0], 0.0).confidence_interval()
    assert robust.harm(episodes, "none", "paper") == {
        "paper, mean, %": f"{(-19 + 100 / 60) / 2:+.1f}",
        "paper, worst policy, %": f"-19.0 [{low:+.1f}, {high:+.1f}] (good)",
    }


def write(file: Path, rows: Sequence[dict[str, Any]]) -> None:
    file.parent.mkdir(parents=True)
    with file.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def new_planner(folder: Path) -> tuple[str, str]:
    controllers = ("off", "paper", "robust", "oracle")
    rows = [{"l1": l1, "bias": 0.0, "episode": 0, "return": -1.0} for l1 in controllers]
    write(folder / "pets/episodes.csv", rows)
    return "planners/episodes.csv", "pets"


def new_reward(folder: Path) -> tuple[str, str]:
    rows = [{"real_steps": 12000, "return_mean": 1.0, "reward_model/explained_variance": 0.5}]
    write(folder / "learned/seed_0/metrics.csv", rows)
    return "learned_rewards.csv", "learned,0"


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    ("name", "measure"), [("planners", new_planner), ("learned_rewards", new_reward)]
)
def test_what_a_folder_lacks_is_kept(
    name: str,
    measure: Callable[[Path], tuple[str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for kept in RESULTS.glob(f"{name}*"):
        (shutil.copytree if kept.is_dir() else shutil.copy)(kept, tmp_path / kept.name)
    copied: ModuleType = script(name, monkeypatch, tmp_path)
    new = tmp_path / "new"
    file, key = measure(new)

    def lines() -> list[str]:
        return (tmp_path / file).read_text().splitlines()

    before = lines()
    monkeypatch.setattr(sys, "argv", [name, str(tmp_path / "mistyped")])
    with pytest.raises(SystemExit, match="mistyped"):
        copied.main()
    assert lines() == before
    monkeypatch.setattr(sys, "argv", [name, str(new)])
    copied.main()
    others = [line for line in before if not line.startswith(key)]
    assert [line for line in lines() if not line.startswith(key)] == others
    assert len(others) < len(lines()) < len(before)


def test_qualities_that_a_campaign_lacks_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offline = script("offline", monkeypatch)
    file = tmp_path / "cells.csv"
    shutil.copy(RESULTS / "offline/cells.csv", file)
    before = offline.kept(file)
    of_run = {"task": "hopper", "quality": "expert", "seed": 0}
    offline.keep([{**offline.select(before, **of_run)[0], "return": 7.0}], file)
    after = offline.kept(file)
    assert [row["return"] for row in offline.select(after, **of_run)] == [7.0]
    others = [row for row in before if not offline.select([row], **of_run)]
    assert [row for row in after if not offline.select([row], **of_run)] == others


@pytest.mark.parametrize("seeds", [2, 3])
def test_offline_learning_has_intervals_and_shares_from_three_seeds_on(
    seeds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    offline = script("offline", monkeypatch)
    gains = {"off": 0.0, "paper": 1.0, "robust": 2.0, "oracle": 4.0}
    episodes = [
        {"task": "hopper", "quality": "expert", "seed": seed, "l1": l1, "bias": bias}
        | {"return": 10.0 * seed + gain * bool(bias) + episode}
        for seed in range(seeds)
        for l1, gain in gains.items()
        for bias in (0.0, 0.2)
        for episode in range(2)
    ]
    summary = offline.summarize(episodes)
    (row,) = offline.select(summary, bias="biased", l1="robust")
    line = rows(offline.recovered_page(summary))[-1]
    if seeds == 2:
        assert (row["return_low"], row["share"]) == ("", "")
        assert line["robust"] == "2, 2" and "robust recovers" not in line
    else:
        low, high = ttest_1samp([2.5, 12.5, 22.5], 0.0).confidence_interval()
        assert (row["return_low"], row["return_high"]) == pytest.approx((low, high))
        assert line["robust recovers"] == "0.50 [0.50, 0.50]"


def test_robust_runs_are_paired_with_the_first_training_on_their_machine() -> None:
    def returns(file: str, l1: str) -> dict[tuple[str, str], float]:
        with (RESULTS / file).open(newline="") as handle:
            return {
                (row["task"], row["seed"]): float(row["return"])
                for row in csv.DictReader(handle)
                if (row["noise"], row["l1"]) == ("none", l1) and not row.get("variant")
            }

    off, robust = returns("trained_twice.csv", "off"), returns("table1/runs.csv", "robust")
    shown = {
        row["task"]: float(row["difference"])
        for row in rows((RESULTS / "questions/table1.md").read_text())
        if (row["L1"], row["noise"]) == ("robust", "none")
    }
    for task, difference in shown.items():
        of_seeds = [
            robust[run] - value for run, value in off.items() if run[0] == task and run in robust
        ]
        assert difference == pytest.approx(sum(of_seeds) / len(of_seeds), rel=6e-3), task


def mean_of(seeds: str) -> float:
    """Of the values of each seed."""
    values = list(map(float, seeds.split(",")))
    return sum(values) / len(values)


def test_offline_page_and_the_advice_quote_what_robust_costs_hopper() -> None:
    found = {
        row["data"]: {l1: mean_of(row[l1]) for l1 in ("off", "robust")}
        for row in rows((RESULTS / "offline/returns.md").read_text())
        if (row["task"], row["bias"]) == ("hopper", "none") and row["data"] != "random"
    }
    text = " ".join((ROOT / "docs/studies/offline.md").read_text().split())
    for of in found.values():
        assert f"{of['robust']:.0f} against {of['off']:.0f}" in text
        assert 0.55 < 1 - of["robust"] / of["off"] < 0.65
    for page in ("README.md", "docs/studies/index.md", "docs/studies/offline.md"):
        assert "three fifths" in (ROOT / page).read_text(), page


CONFIG = L1Config.robust(0.02, action_low=-1.0, action_high=1.0)


def test_robust_controllers_act_by_the_rule_of_a_study(monkeypatch: pytest.MonkeyPatch) -> None:
    acting = script("acting", monkeypatch)
    known = Posterior(torch.full((1, 1), 0.1), torch.ones(1, 1, 1))  # within the dead zone
    zero = torch.zeros(1, 1)
    estimated = kalman_law.Estimate(known, zero, None, *[zero] * 4)

    def correction() -> float:
        return float(kalman_law.adapted(CONFIG, estimated, torch.zeros(1, 1)).q)

    assert correction() == 0
    with acting.acting_by(lambda posterior: 3 * posterior.mean):
        assert correction() == pytest.approx(0.3)
    assert correction() == 0


def test_what_the_record_of_forecasts_changes_on_other_policies_is_counted() -> None:
    with (RESULTS / "record.csv").open(newline="") as handle:
        returns = {
            (row["policy"].replace("_", " "), row["disturbance"], row["l1"]): np.array(
                row["returns"].split(), np.float64
            )
            for row in csv.DictReader(handle)
        }
    better: dict[str, list[tuple[str, str]]] = {"change": [], "with it less without L1": []}
    worse: dict[str, list[tuple[str, str]]] = {name: [] for name in better}
    cells = rows((RESULTS / "record.md").read_text())
    for cell in cells:
        at = cell["policy"], cell["disturbance"]
        for name, base in zip(better, ("whole", "off"), strict=True):
            change = returns[*at, "robust"] - returns[*at, base]
            low, high = ttest_1samp(change, 0.0).confidence_interval()
            if change.any():
                shown = list(map(float, re.findall(r"-?[\d.]+", cell[name])))
                assert shown == pytest.approx([change.mean(), low, high], rel=0.02, abs=0.6), at
            for found, is_so in ((better, low > 0), (worse, high < 0)):
                if is_so:
                    found[name].append(at)
    assert len(cells) == 35
    late = "actuators two steps late"
    dead = [("half cheetah seed 2", "dead zone 0.2"), ("hopper seed 1", "dead zone 0.2")]
    assert better["change"] == [dead[0], ("swimmer seed 1", late)]
    assert worse["change"] == [("walker seed 1", late)]
    assert len(better["with it less without L1"]) == 6
    assert all("bias" in words for _, words in better["with it less without L1"])
    assert worse["with it less without L1"] == dead
    text = " ".join((ROOT / "docs/studies/suite.md").read_text().split())
    told = [
        "goes from {:.0f} to {:.0f}".format(*(returns[*at, l1].mean() for l1 in ("off", "robust")))
        for at in dead
    ]
    assert f"{told[0]} and Hopper's seed 1 {told[1].removeprefix('goes ')}" in text


def test_what_a_study_puts_in_place_of_the_shipped_controller_acts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bounds = script("at_the_bounds", monkeypatch)
    one = torch.ones(2, 1)
    # At the upper bound, where a disturbance outwards is expected to end.
    state = init([2], 1, 1, CONFIG)._replace(
        u_bar=one, sigma_m=0.5 * one, started=one.bool(), covariance=0.1 * one, jacobian=one
    )

    def believes() -> list[bool]:
        """Whether pushes of the plant inwards and outwards change the estimate."""
        estimated = kalman_law.estimate(CONFIG, state, torch.tensor([[-4.0], [4.0]]))
        return (estimated.posterior.mean != 0.5).flatten().tolist()

    assert believes() == [True, False]
    with mock.patch.object(*bounds.NOTHING_CONTRADICTS):
        assert believes() == [False, False]
    with mock.patch.object(*bounds.NOTHING_ENDS):
        assert believes() == [True, True]
    with mock.patch.object(*bounds.LATE):
        env = make_pipeline(TASKS["inverted_pendulum"], 1, Perturbation(), None, ORACLE)
    assert sum(isinstance(one, bounds.LateOracle) for one in env.transform) == 1
