"""Numbers that the studies' pages quote, counted anew from the data beside the scripts."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from itertools import chain, product
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, t, ttest_1samp

from tests.test_studies import script

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs/results"
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
NAMES = {
    "the pendulum": "inverted_pendulum",
    **{task.title().replace("_", ""): task for task in TASKS[1:]},
}
UNDISTURBED = (0.0, 0.0)
Row = dict[str, str]
Cell = tuple[str, ...]
Bias = tuple[float, float]  # a constant one, and one of random signs
Returns = dict[tuple[str, str, str, Bias], float]


def page(name: str) -> str:
    """A page in one line."""
    return " ".join((ROOT / f"docs/{name}.md").read_text().split())


def read(name: str) -> list[Row]:
    """A table of the results."""
    with (RESULTS / name).open(newline="") as handle:
        return list(csv.DictReader(handle))


def written(name: str) -> list[Row]:
    """A table that a script has written for a page."""
    lines = (RESULTS / name).read_text().splitlines()
    head, _, *body = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [dict(zip(head, line, strict=True)) for line in body]


def values(text: str) -> np.ndarray:
    """Numbers of a cell with several."""
    return np.array(text.split(), dtype=np.float64)


def interval(of: np.ndarray) -> tuple[float, float]:
    """95 % interval of a mean, by Student's t."""
    half = t.ppf(0.975, len(of) - 1) * of.std(ddof=1) / len(of) ** 0.5
    return of.mean() - half, of.mean() + half


def differences(editions: Iterable[str], l1: str, policy: str) -> dict[Cell, np.ndarray]:
    """Of all pairs by task and noise, from the edition that has most, or the latest of these."""
    found: dict[Cell, np.ndarray] = {}
    for row in chain.from_iterable(read(f"{edition}/pairs.csv") for edition in editions):
        if (row["l1"], row["policy"], row["variant"]) == (l1, policy, "") and row["differences"]:
            cell, new = (row["task"], row["noise"]), values(row["differences"])
            if len(new) >= len(found.get(cell, ())):
                found[cell] = new
    if l1 == "robust":  # its runs are of the machine on which some without L1 were trained first
        column = {"stochastic": "return", "deterministic": "return_deterministic"}[policy]
        returns = {
            (row["task"], row["noise"], row["l1"], row["seed"]): float(row[column])
            for row in read("table1/runs.csv") + read("trained_twice.csv")
            if row["return"]
        }
        for cell, of in found.items():
            seeds = map(str, range(len(of)))
            found[cell] = np.array(
                [returns[*cell, l1, seed] - returns[*cell, "off", seed] for seed in seeds]
            )
    return found


ARMS = {
    ("METRPO", "paper"): ("table1_first", "table1"),
    ("METRPO", "robust"): ("table1",),
    ("MBMF", "paper"): ("mbmf", "mbmf_rest"),
}
ACTIONS = {"stochastic": "sampled", "deterministic": "mean"}


def test_in_how_many_pairs_and_cells_l1_is_ahead_is_counted() -> None:
    rows = written("questions/ahead.md")
    index, mbmf = page("studies/index"), page("studies/mbmf")
    for (arm, (policy, action)), row in zip(product(ARMS, ACTIONS.items()), rows, strict=True):
        assert (row["algorithm"], row["L1 in training"], row["action"]) == (*arm, action)
        of = differences(ARMS[arm], arm[1], policy)
        single = np.concatenate(list(of.values()))
        pairs = (np.sum(single > 0), np.sum(single != 0))
        cells = (sum(one.mean() > 0 for one in of.values()), len(of))
        assert row["pairs"] == "{} of {}".format(*pairs)
        assert row["cells"] == "{} of {}".format(*cells)
        assert f"in {row['pairs']} pairs" in index
        low, high = map(float, row["share of cells"].partition("[")[2].strip("]").split(","))
        assert low < 0.5 < high, "the page says that all of them contain a half"
        if arm[0] == "MBMF":
            assert re.search(rf"39 pairs it is ahead in .*\b{pairs[0]}\b.*, of the cells", mbmf)
    # Both tails of a fair coin, for the last row.
    often = [2 * binom.sf(ahead - 1, many, 0.5) for ahead, many in (pairs, cells)]
    assert (round(1000 * often[0]), round(100 * often[1])) == (9, 12)
    assert "as much as 28 of 39, one way or the other, nine times in a thousand" in mbmf
    assert "as much as 11 of 15 cells it does twelve times in a hundred" in mbmf
    assert "28 of 39 in one of a hundred cases; as far as 11 of 15 cells, in one of eight" in index
    assert round(1 / often[1]) == 8


def finals(edition: str, task: str, l1: str) -> dict[str, float]:
    """Final returns without noise, by seed."""
    return {
        row["seed"]: float(row["return"])
        for row in read(f"{edition}/runs.csv")
        if (row["task"], row["noise"], row["l1"]) == (task, "none", l1) and not row["variant"]
    }


def test_hoppers_baseline_of_the_second_edition_is_quoted() -> None:
    first, second = (finals(edition, "hopper", "off") for edition in ("baselines", "table1"))
    assert [*first, "2"] == list(second)
    [authors] = {
        float(row["authors_mean"])
        for row in read("baselines/training.csv")
        if row["task"] == "hopper"
    }
    words = "return {:.0f}, {:.0f} and {:.0f}, less in the mean than the authors' {:.0f}".format(
        *second.values(), authors
    )
    assert words in page("studies/baselines")
    assert np.mean(list(second.values())) < authors < np.mean(list(first.values()))


def test_half_cheetahs_pairs_of_the_second_edition_are_quoted() -> None:
    found = differences(["table1"], "paper", "stochastic")["half_cheetah", "none"]
    one, *others = (f"{abs(value):.0f}" for value in found)
    words = (
        f"three pairs lose {one} and gain {others[0]} and {others[1]}: "
        f"mean difference {found.mean():.0f}, interval [{{:.0f}}, {{:.0f}}]"
    )
    assert words.format(*interval(found)) in page("studies/table1")
    off, on = (
        np.mean(list(finals("table1", "half_cheetah", l1).values())) for l1 in ("off", "paper")
    )
    assert f"and {off:.0f} and {on:.0f} in the second with three" in page("studies/index")


def biased(task: str) -> Returns:
    """Mean returns of the frozen policies, by policy, controller, noise and bias."""
    found: dict[tuple[str, str, str, Bias], list[float]] = {}
    for row in read(f"robust/{task}.csv"):
        key = (row["run"], row["l1"], row["noise"], (float(row["bias"]), float(row["signs"])))
        found.setdefault(key, []).append(float(row["return"]))
    return {key: float(np.mean(of)) for key, of in found.items()}


def over(returns: Returns, l1: str, biases: Iterable[Bias]) -> dict[str, float]:
    """Mean over biases, by policy."""
    runs = sorted({run for run, *_ in returns})
    return {run: float(np.mean([returns[run, l1, "none", one] for one in biases])) for run in runs}


def every_bias(returns: Returns) -> list[Bias]:
    """Those that were tested."""
    return [bias for bias in dict.fromkeys(key[3] for key in returns) if bias != UNDISTURBED]


def test_what_controllers_make_of_all_six_biases_is_quoted() -> None:
    text = page("studies/index")
    for task in TASKS:
        returns = biased(task)
        six = every_bias(returns)
        assert len(six) == 6
        off, on = (np.mean(list(over(returns, l1, six).values())) for l1 in ("off", "robust"))
        assert on > off, "the page says that it returns more on all five tasks"
        if task == "walker":
            assert f"Walker's {on:.0f} for {off:.0f}." in text
    returns, suits = biased("hopper"), (-0.4, 0.0)
    undisturbed = returns["seed_0", "off", "none", UNDISTURBED]
    off, robust, oracle = (
        returns["seed_0", l1, "none", suits] for l1 in ("off", "robust", "oracle")
    )
    words = f"returns {undisturbed:.0f} undisturbed and {off:.0f} at a bias of -0.4"
    for one in (text, page("studies/robustness")):
        assert words in one
        assert f"makes {robust:.0f} of that" in one and f"the oracle {oracle:.0f}" in one


def single_policies() -> list[dict[str, str]]:
    """What each policy loses and gets back, as the script wrote it."""
    return written("robust/policies.md")


def test_shares_of_single_policies_are_quoted() -> None:
    first = page("studies/robustness").partition(" ## ")[0]
    index = page("studies/index").partition("## What does L1 recover")[2].partition("![")[0]

    def between(l1: str) -> str:
        """The lowest share and the highest, with their policies."""
        of = [(float(row[f"{l1} recovers"].split()[0]), row) for row in single_policies()]
        ends = [pick(of, key=lambda entry: entry[0]) for pick in (min, max)]
        names = {task: name for name, task in NAMES.items()}
        words = [f"{share:.2f} ({names[row['task']]}, {row['policy']})" for share, row in ends]
        return f"between {words[0]} and {words[1]}"

    assert between("robust") in first and between("robust") in index
    assert f"the paper's {between('paper')}" in index
    held_out = [
        float(row["robust recovers"].split()[0])
        for row in single_policies()
        if not (row["policy"] == "seed 0" and row["task"] in ("swimmer", "hopper", "walker"))
    ]
    assert f"its shares are {min(held_out):.2f} to {max(held_out):.2f} on the other" in page(
        "studies/index"
    )
    paper = {
        task: [row["paper recovers"].split()[0] for row in single_policies() if row["task"] == task]
        for task in TASKS
    }
    walker, cheetah = paper["walker"], paper["half_cheetah"]
    hopper = sorted(paper["hopper"], key=float)
    told = f"gets back {hopper[0]} to {hopper[-1]} on Hopper, {walker[0]} and {walker[1]} on Walker"
    words = f"{told}, and {cheetah[0]}, {cheetah[1]} and {cheetah[2]} on HalfCheetah"
    assert words in first


def test_what_controllers_cost_where_there_is_nothing_to_cancel_is_quoted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robust = script("robust", monkeypatch)
    lower: dict[str, list[tuple[str, str, str, float]]] = {"paper": [], "robust": []}
    pairs = 0
    for task in TASKS:
        more = RESULTS / f"robust/undisturbed_{task}.csv"
        episodes = robust.read(more if more.exists() else RESULTS / f"robust/{task}.csv")
        for run in sorted({row["run"] for row in episodes}):
            for noise in ("none", "action", "observation"):
                pairs += 1
                off = robust.returns(episodes, run, "off", [robust.NONE], noise)
                for l1, found in lower.items():
                    on = robust.returns(episodes, run, l1, [robust.NONE], noise)
                    change = (on - off) / abs(off.mean()) * 100
                    high = ttest_1samp(change, 0.0).confidence_interval().high
                    if high < 0:
                        found.append((task, run, noise, float(change.mean())))
    one, two, three = lower["robust"]
    assert one[:3] == ("swimmer", "seed_2", "action") and f"{-one[3]:.1f}" == "0.2"
    assert two[:3] == ("hopper", "seed_1", "none") and f"{-two[3]:.1f}" == "19.6"
    assert three[:3] == ("hopper", "seed_2", "action") and 4.5 < -three[3] < 5.5
    first = " ".join((ROOT / "docs/studies/robustness.md").read_text().split())
    assert f"in three of the {pairs} pairs of a policy and a noise" in first
    assert f"The paper's lowers it in {len(lower['paper'])} of them" in first
    harm = written("robust/harm.md")
    worst = next(row for row in harm if (row["task"], row["noise"]) == ("hopper", "none"))
    low, high = re.findall(r"-([\d.]+)[,\]]", worst["robust, worst policy, %"])
    index = " ".join((ROOT / "docs/studies/index.md").read_text().split())
    assert f"costs one of Hopper's 19.6 % of its return [{high}, {low}]" in index
    costs = {(row["task"], row["noise"]): f"{-float(row['paper, mean, %']):.0f}" for row in harm}
    help_page = (ROOT / "docs/l1.md").read_text()
    for words, noise, tasks in (
        ("{}, {} and {} % (mean", "action", ("half_cheetah", "walker", "hopper")),
        ("{}, {} and {} % of their return", "observation", ("hopper", "walker", "half_cheetah")),
    ):
        assert words.format(*(costs[task, noise] for task in tasks)) in help_page


def test_what_a_dead_zone_of_one_costs_is_quoted() -> None:
    changes: dict[str, list[float]] = {}
    undisturbed = {
        (row["task"], row["seed"]): float(row["return"])
        for row in read("acting.csv")
        if (row["condition"], row["rule"]) == ("undisturbed", "off")
    }
    for row in read("acting.csv"):
        if row["rule"] == "dead zone, z = 1":
            share = float(row["difference"]) / undisturbed[row["task"], row["seed"]]
            changes.setdefault(row["condition"], []).append(-100 * share)
    noisy, shaken = changes["observation noise"], changes["action noise"]
    words = (
        f"it cost {np.mean(noisy):.1f} % in the mean of four policies and {max(noisy):.1f} % on "
        f"the worst, with noisy actions {max(shaken):.1f} % on the worst"
    )
    assert words in page("studies/index")


def test_what_seeds_of_offline_learning_differ_in_is_quoted() -> None:
    found: dict[tuple[str, str, str, str], dict[float, float]] = {}
    for row in read("offline/cells.csv"):
        key = (row["task"], row["quality"], row["seed"], row["l1"])
        found.setdefault(key, {})[float(row["bias"])] = values(row["returns"]).mean()

    def gain(task: str, quality: str, seed: str, l1: str) -> float:
        off, on = (found[task, quality, seed, one] for one in ("off", l1))
        return float(np.mean([on[bias] - off[bias] for bias in off if bias]))

    text = page("studies/offline")
    lost, gained = (gain("half_cheetah", "random", seed, "oracle") for seed in "01")
    assert f"by {-lost:.0f} on one seed; on the other it gains {gained:.0f}" in text
