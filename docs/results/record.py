"""The robust controller with its record of forecasts and without, on other policies.

    python docs/results/record.py [RUN ...]

Plays the mean action of each run, 8 episodes from the resets of the suite, without L1, with the
robust controller and with the same that acts on its whole estimate (`skill_forgetting=1`), under
disturbances of which some last and some outrun the estimate. Keeps the returns in `record.csv`
beside this file, in place of those of the same run, and writes `record.md` from it.
"""

from __future__ import annotations

import csv
import sys
from contextlib import nullcontext
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from torchrl_l1.algorithms.collection import episode_returns
from torchrl_l1.control import kalman
from torchrl_l1.experiment.evaluate import load_run, make_collection
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.report.page import markdown
from torchrl_l1.report.statistics import student_interval

HERE = Path(__file__).parent
EPISODES, SEED = 8, 0
CELLS: dict[str, dict[str, float]] = {
    "none": {},
    "bias of random signs 0.3": {"signs": 0.3},
    "bias from step 50 on, 0.3": {"step": 0.3},
    "dead zone 0.2": {"deadzone": 0.2},
    "actuators one step late": {"delay": 1.0},
    "actuators two steps late": {"delay": 2.0},
    "sensors two steps late": {"sensor_delay": 2.0},
}
ARMS = ("off", "whole", "robust")
Row = dict[str, str]


def measure(run: Path) -> list[Row]:
    """One row per disturbance and arm: the returns of all episodes."""
    trained = load_run(run)
    policy = f"{trained.recipe.task} seed {trained.recipe.seed}"
    rows = []
    for words, disturbances in CELLS.items():
        for arm in ARMS:
            l1 = "off" if arm == "off" else "robust"
            condition = Condition(l1=l1, policy="deterministic", disturbances=disturbances)
            whole = mock.patch.object(kalman, "skill", lambda sums: torch.ones_like(sums[..., :1]))
            with whole if arm == "whole" else nullcontext():
                data = make_collection(trained, condition, EPISODES).evaluate(SEED)
            returns = " ".join(f"{value:.6g}" for value in episode_returns(data).tolist())
            rows.append({"policy": policy, "disturbance": words, "l1": arm, "returns": returns})
            print(policy, words, arm, returns, flush=True)
    return rows


def less(one: np.ndarray, other: np.ndarray) -> str:
    """Mean difference of paired episodes, with its interval."""
    difference = one - other
    return f"{difference.mean():.3g} {student_interval(difference.tolist()):.3g}"


def table(rows: list[Row]) -> str:
    """Mean returns, and their differences, with 95 % intervals by Student's t over episodes."""
    of = {
        (row["policy"], row["disturbance"], row["l1"]): np.array(row["returns"].split(), np.float64)
        for row in rows
    }
    lines = []
    for policy in dict.fromkeys(row["policy"] for row in rows):
        for words in CELLS:
            returns = {arm: of[policy, words, arm] for arm in ARMS}
            lines.append(
                {
                    "policy": policy.replace("_", " "),
                    "disturbance": words,
                    "without L1": f"{returns['off'].mean():.4g}",
                    "without the record": f"{returns['whole'].mean():.4g}",
                    "with it": f"{returns['robust'].mean():.4g}",
                    "change": less(returns["robust"], returns["whole"]),
                    "with it less without L1": less(returns["robust"], returns["off"]),
                }
            )
    return markdown(lines)


def main() -> None:
    """Measure what is given, and write the table of all that is there."""
    file = HERE / "record.csv"
    rows: list[Row] = []
    if file.exists():
        with file.open(newline="") as handle:
            rows = list(csv.DictReader(handle))
    for run in sys.argv[1:]:
        new = measure(Path(run))
        rows = [row for row in rows if row["policy"] != new[0]["policy"]] + new
        rows.sort(key=lambda row: row["policy"])
        write_table(file, rows)
    (HERE / "record.md").write_text(table(rows) + "\n")
    print(f"Table: {HERE / 'record.md'}")


if __name__ == "__main__":
    main()
