"""Rules by which the robust controller acts on its estimate, compared on frozen policies.

    python docs/results/acting.py [RUN ...]

Every rule gets the same posterior mean d and standard deviation s of the disturbance, from the same
Kalman filter, and says what the input cancels. Keeps the returns of 16 episodes of the policy's
mean action, paired by their resets with L1 off, in `acting.csv` beside this file, in place of those
of the same policies, and writes from all of them `acting.md`, the change of the return, and
`acting_recovered.md`, the shares of what the oracle gets back of a bias.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

from torchrl_l1.algorithms.collection import episode_returns
from torchrl_l1.control import kalman
from torchrl_l1.experiment.evaluate import TrainedRun, load_run, make_collection
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.report.page import markdown

HERE = Path(__file__).parent
EPISODES, SEED = 16, 0
CONDITIONS: dict[str, dict[str, Any]] = {
    "undisturbed": {},
    "action noise": {"noise": "action"},
    "observation noise": {"noise": "observation"},
    "bias 0.2": {"disturbances": {"bias": 0.2}},
    "bias 0.4": {"disturbances": {"bias": 0.4}},
    "bias -0.4": {"disturbances": {"bias": -0.4}},
    "step 0.2": {"disturbances": {"step": 0.2}},
}
RECOVERED = ("everything (z = 0)", "dead zone, z = 1", "dead zone, z = 2", "dead zone, z = 3")
Row = dict[str, Any]
Rule = Callable[[kalman.Posterior], Tensor]
shipped = kalman.significant


def _deviation(posterior: kalman.Posterior) -> Tensor:
    return posterior.covariance.diagonal(dim1=-2, dim2=-1).sqrt()


def shrunk(posterior: kalman.Posterior) -> Tensor:
    """The posterior mean of a normal prior as wide as the estimate: d / (1 + (s / d)^2)."""
    square = posterior.mean.square()
    return posterior.mean * square / (square + _deviation(posterior).square()).clamp_min(1e-12)


def soft(posterior: kalman.Posterior) -> Tensor:
    """Two standard deviations subtracted from the magnitude."""
    size = (posterior.mean.abs() - 2 * _deviation(posterior)).clamp_min(0)
    return posterior.mean.sign() * size


def less_expected(expected: Tensor) -> Rule:
    """The mean estimate of undisturbed episodes subtracted, entry by entry."""
    return lambda posterior: posterior.mean - expected


def acting_by(rule: Rule) -> AbstractContextManager[object]:
    """Meanwhile robust controllers act on their estimates by a rule."""
    return mock.patch.object(kalman, "significant", lambda posterior, dead_zone: rule(posterior))


def rules(trained: TrainedRun) -> dict[str, Rule]:
    """By name; the one that needs undisturbed episodes takes them from the policy itself."""
    with acting_by(lambda posterior: torch.zeros_like(posterior.mean)):
        idle = make_collection(trained, Condition("robust"), EPISODES).evaluate(SEED + 1)
    expected = idle["next", "l1", "sigma_m"].flatten(0, -2).mean(0)
    return {
        "everything (z = 0)": lambda posterior: posterior.mean,
        "dead zone, z = 1": lambda posterior: shipped(posterior, 1.0),
        "dead zone, z = 2": lambda posterior: shipped(posterior, 2.0),
        "dead zone, z = 3": lambda posterior: shipped(posterior, 3.0),
        "soft threshold, z = 2": soft,
        "shrinkage": shrunk,
        "expected estimate subtracted": less_expected(expected),
    }


def compare(trained: TrainedRun) -> list[Row]:
    """One row per rule and condition of a run."""
    rows = []
    for name, test in CONDITIONS.items():
        cell = {"policy": "deterministic", **test}
        off = _returns(trained, Condition("off", **cell))
        rows.append(_row(trained, name, "off", off, off))
        if "disturbances" in test:
            oracle = _returns(trained, Condition("oracle", **cell))
            rows.append(_row(trained, name, "oracle", oracle, off))
        for rule, function in rules(trained).items():
            with acting_by(function):
                robust = _returns(trained, Condition("robust", **cell))
            rows.append(_row(trained, name, rule, robust, off))
        returns = [round(row["return"]) for row in rows if row["condition"] == name]
        print(trained.path, name, returns, flush=True)
    return rows


def _returns(trained: TrainedRun, cell: Condition) -> np.ndarray:
    return episode_returns(make_collection(trained, cell, EPISODES).evaluate(SEED)).numpy()


def _row(trained: TrainedRun, name: str, rule: str, returns: np.ndarray, off: np.ndarray) -> Row:
    difference = returns - off
    return {
        "task": trained.recipe.task,
        "seed": trained.recipe.seed,
        "condition": name,
        "rule": rule,
        "return": round(float(returns.mean()), 2),
        "difference": round(float(difference.mean()), 2),
        "standard_error": round(float(difference.std(ddof=1) / len(difference) ** 0.5), 2),
    }


def lines(rows: Sequence[Row]) -> list[Row]:
    """A row per rule, a column per condition: mean over runs of the change, in % of undisturbed."""
    found = []
    for rule in dict.fromkeys(row["rule"] for row in rows if row["rule"] not in ("off", "oracle")):
        line: Row = {"rule": rule}
        for name in CONDITIONS:
            changes = [
                100 * difference / abs(_value(rows, policy, "undisturbed", "off", "return"))
                for policy in _policies(rows)
                if (difference := _value(rows, policy, name, rule)) is not None
            ]
            line[name] = f"{np.mean(changes):+.1f} ({min(changes):+.1f})" if changes else "–"
        found.append(line)
    return found


def recovered(rows: Sequence[Row]) -> list[Row]:
    """A row per policy and costly bias: the share of the oracle's gain that each rule gets back."""
    found = []
    for policy in _policies(rows):
        for name in ("bias 0.2", "bias 0.4", "bias -0.4"):
            gain = _value(rows, policy, name, "oracle")
            error = _value(rows, policy, name, "oracle", "standard_error")
            if gain is None or gain < 2 * error:
                continue
            line: Row = {"task": policy[0], "seed": policy[1], "disturbance": name}
            line["oracle"] = f"{gain:+.4g}"
            for rule in RECOVERED:
                line[rule] = f"{_value(rows, policy, name, rule) / gain:.2f}"
            found.append(line)
    return found


def _policies(rows: Sequence[Row]) -> list[tuple[str, str]]:
    return sorted({(row["task"], str(row["seed"])) for row in rows})


def _value(
    rows: Sequence[Row], policy: tuple[str, str], name: str, rule: str, of: str = "difference"
) -> Any:
    for row in rows:
        if (row["task"], str(row["seed"]), row["condition"], row["rule"]) == (*policy, name, rule):
            return float(row[of])
    return None


def main() -> None:
    """Test the policies of the runs that are named, then write the tables."""
    runs = sys.argv[1:]
    kept = HERE / "acting.csv"
    rows: list[Row] = [row for run in runs for row in compare(load_run(run))]
    with kept.open(newline="") as handle:
        old = [r for r in csv.DictReader(handle) if (r["task"], r["seed"]) not in _policies(rows)]
    rows = sorted([*old, *rows], key=lambda row: (row["task"], str(row["seed"])))
    write_table(kept, rows)
    policies = [f"{task} (seed {seed})" for task, seed in _policies(rows)]
    note = (
        "Change of the return against L1 off, in % of the undisturbed return without L1: mean over "
        f"the policies {', '.join(policies)}, in brackets the worst of them; {EPISODES} episodes "
        "each."
    )
    (HERE / "acting.md").write_text(f"{markdown(lines(rows))}\n\n{note}\n")
    (HERE / "acting_recovered.md").write_text(markdown(recovered(rows)) + "\n")
    print(f"Tables: {HERE / 'acting.md'}, {HERE / 'acting_recovered.md'}")


if __name__ == "__main__":
    main()
