"""Numbers that the studies' pages quote, counted anew from the data beside the scripts."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from itertools import chain, product
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, t

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs/results"
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
SPELLED = {task.replace("_", ""): task for task in TASKS}
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
    assert first.keys() == second.keys()
    [authors] = {
        float(row["authors_mean"])
        for row in read("baselines/training.csv")
        if row["task"] == "hopper"
    }
    words = "return {:.0f} and {:.0f}, the authors' {:.0f}".format(*second.values(), authors)
    assert words in page("studies/baselines")
    assert max(second.values()) < authors < np.mean(list(first.values()))


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


def test_what_two_machines_make_of_walker_is_quoted() -> None:
    def mean_action(rows: list[Row], l1: str) -> float:
        [found] = [
            float(row["return_deterministic"])
            for row in rows
            if (row["task"], row["noise"], row["l1"], row["seed"]) == ("walker", "none", l1, "0")
        ]
        return found

    robust, paired = (mean_action(read("table1/runs.csv"), l1) for l1 in ("robust", "off"))
    own = mean_action(read("trained_twice.csv"), "off")
    words = (
        f"returns {robust:.0f} with the robust controller, {robust / paired:.1f} times the "
        f"{paired:.0f} of the run that it is paired with, but {robust / own:.1f} times the "
        f"{own:.0f} of its own"
    )
    assert words in page("studies/table1")


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


@pytest.mark.parametrize("task", TASKS)
def test_what_controllers_make_of_all_six_biases_is_quoted(task: str) -> None:
    returns, text = biased(task), page("studies/index")
    six = every_bias(returns)
    assert len(six) == 6
    means = {
        l1: np.mean(list(over(returns, l1, six).values()))
        for l1 in ("off", "paper", "robust", "oracle")
    }
    if task != "walker":
        assert means["robust"] > means["off"], "the page says that it gains on the other four"
        return
    words = (
        "{off:.0f} without a controller, {robust:.0f} with the robust one, {oracle:.0f} with the "
    )
    assert words.format(**means) + f"oracle and {means['paper']:.0f} with the paper's" in text
    off, on = (sum(over(returns, l1, [(-0.2, 0.0)]).values()) for l1 in ("off", "robust"))
    assert f"at a bias of -0.2 the robust controller costs them {1 - on / off:.0%}" in text.replace(
        " %", "%"
    )


def test_extreme_shares_of_the_oracles_gain_are_quoted() -> None:
    text = page("studies/index")
    for l1, words in (("robust", "(#how-to-read-them)) gets"), ("paper", "gain, the paper's")):
        shares = {
            row["task"]: float(row[f"{l1} recovered"].split()[0])
            for row in written("robust/overall.md")
        }
        found = re.search(rf"{re.escape(words)} between (\S+) \((\w+)\) and (\S+) \((\w+)\)", text)
        assert found is not None
        for number, name, extreme in ((found[1], found[2], min), (found[3], found[4], max)):
            assert float(number) == shares[SPELLED[name.lower()]] == extreme(shares.values())


def test_shares_of_half_cheetahs_policies_are_quoted() -> None:
    returns, text = biased("half_cheetah"), page("studies/index")
    # All biases but one, at which the oracle's gain is not told from chance.
    costly = [bias for bias in every_bias(returns) if bias != (0.2, 0.0)]
    of = {l1: over(returns, l1, costly) for l1 in ("off", "paper", "robust", "oracle")}

    def share(l1: str, runs: Iterable[str]) -> str:
        gain, gap = (sum(of[one][run] - of["off"][run] for run in runs) for one in (l1, "oracle"))
        return f"{gain / gap:.2f}"

    runs = list(of["off"])
    first, second, third, last = (share("paper", [run]) for run in runs)
    assert f"the paper's are {first}, {second}, {third} and {last}." in text
    robust, paper = (share(l1, runs[2:]) for l1 in ("robust", "paper"))
    assert f"give {robust} with the robust controller and {paper} with the paper's" in text


def test_shares_of_two_other_policies_of_hopper_are_quoted() -> None:
    found: dict[str, list[str]] = {"paper": [], "robust": []}
    for row in read("table1/disturbances.csv"):
        place = (row["task"], row["gain"], row["training_seeds"])
        if place == ("hopper", "1.0", "2") and float(row["bias"]) > 0 and row["l1"] in found:
            found[row["l1"]].append(f"{float(row['recovered']):.2f}")
    words = "recovers {} and {} under the two biases that count there, the robust one {} and {}."
    assert words.format(*found["paper"], *found["robust"]) in page("studies/index")


def test_what_robust_costs_where_nothing_is_wrong_is_quoted() -> None:
    changes: list[tuple[float, bool]] = []
    for task in TASKS:
        more = RESULTS / f"robust/undisturbed_{task}.csv"
        returns = biased(f"undisturbed_{task}" if more.exists() else task)
        for run, noise in product({run for run, *_ in returns}, ("none", "action", "observation")):
            off, on = (returns[run, l1, noise, UNDISTURBED] for l1 in ("off", "robust"))
            learned = task == "inverted_pendulum" or off > 1
            if (task, run) != (
                "swimmer",
                "seed_2",
            ):  # swims nowhere: a change is a share of nothing
                changes.append(((on - off) / abs(off), learned))
    worst = -100 * min(change for change, _ in changes)
    of_learned = -100 * min(change for change, learned in changes if learned)
    cells = [row["L1 robust, %"].split(maxsplit=1) for row in written("robust/harm.md")]
    mean, ends = min(cells, key=lambda cell: float(cell[0]))
    words = (
        f"at worst {-float(mean):.1f} % lower {ends}, and that of single policies up to "
        f"{worst:.1f} % ({of_learned:.1f} % of those that have learned their task)"
    )
    assert words in page("studies/index")


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

    def cost(quality: str, seed: str) -> str:
        off, on = (found["hopper", quality, seed, one][0.0] for one in ("off", "robust"))
        return f"{100 * (1 - on / off):.0f}"

    text = page("studies/offline")
    one, other = (
        gain("hopper", "medium", seed, "robust") / gain("hopper", "medium", seed, "oracle")
        for seed in "01"
    )
    assert f"share is {one:.2f} on one and {other:.2f} on the other" in text
    medium, expert = ([cost(quality, seed) for seed in "01"] for quality in ("medium", "expert"))
    words = "{} and {} % on the two seeds with medium data, {} and {} % with expert data"
    assert words.format(*medium, *expert) in text
    lost, gained = (gain("half_cheetah", "random", seed, "oracle") for seed in "01")
    assert f"by {-lost:.0f} on one seed; on the other it gains {gained:.0f}" in text


def test_what_the_record_changes_under_a_step_is_quoted() -> None:
    of: dict[str, dict[float, np.ndarray]] = {}
    for row in read("suite/half_cheetah.csv"):
        if row["disturbance"] == "step":
            of.setdefault(row["l1"], {})[float(row["value"])] = values(row["returns"])
    means = {l1: np.mean(list(cells.values()), axis=0) for l1, cells in of.items()}
    gap = np.mean(means["oracle"] - means["off"])
    without, with_it = (np.mean(means[l1] - means["off"]) / gap for l1 in ("whole", "robust"))
    change = means["robust"] - means["whole"]
    words = (
        f"got back {without:.2f} of the oracle's gain without the record, and gets {with_it:.2f} "
        f"with it (difference of the returns {change.mean():.0f} [{{:.0f}}, {{:.0f}}])"
    )
    assert words.format(*interval(change)) in page("studies/index")


def test_other_policies_that_lose_with_the_record_are_told() -> None:
    returns = {
        (row["policy"], row["disturbance"], row["l1"]): values(row["returns"])
        for row in read("record.csv")
    }
    lose = set()
    for policy, words, l1 in returns:
        if l1 == "robust":
            change = returns[policy, words, l1] - returns[policy, words, "off"]
            if interval(change)[1] < 0:
                lose.add((policy, words))
    assert lose == {
        ("half_cheetah seed 1", "dead zone 0.2"),
        ("half_cheetah seed 2", "dead zone 0.2"),
        ("half_cheetah seed 2", "sensors two steps late"),
    }
    words = (
        "both of HalfCheetah lose under a dead zone, and one of them with sensors two steps late"
    )
    assert words in page("studies/index")
