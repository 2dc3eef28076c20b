"""Hopper under an actuator bias: who keeps it standing, for how long, and how it looks.

    torchrl-l1 run metrpo/hopper l1=off threads=1 run_dir=runs/hopper --resume
    python docs/results/hopper.py runs/hopper

Writes `hopper.csv` (one row per episode), `hopper.md`, `hopper.png` and the folder `hopper` with
the filmstrip beside this file: 24 episodes of the policy's mean action per controller and bias. A
hopper has fallen where its torso is below 0.7 m, which is no end of the task's episodes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from torchrl_l1.algorithms.collection import episode_returns
from torchrl_l1.cli.evaluate import write_filmstrip
from torchrl_l1.experiment.evaluate import TrainedRun, load_run, make_collection
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.report.page import markdown

HERE = Path(__file__).parent
CONTROLLERS = {"off": "#999999", "paper": "#d55e00", "robust": "#0072b2", "oracle": "#000000"}
BIASES = (0.0, -0.4, 0.4)
FALLEN = 0.7
EPISODES, SEED = 24, 0
Row = dict[str, Any]


def condition(controller: str, bias: float) -> Condition:
    """One cell of the evaluation."""
    return Condition(l1=controller, policy="deterministic", disturbances={"bias": bias})


def measure(trained: TrainedRun) -> tuple[list[Row], dict[tuple[str, float], np.ndarray]]:
    """Rows of single episodes, and for each cell when they fell ``(episodes,)``, in seconds."""
    rows, falls = [], {}
    dt = trained.algorithm.task.dt
    for bias in BIASES:
        for controller in CONTROLLERS:
            collection = make_collection(trained, condition(controller, bias), EPISODES)
            data = collection.evaluate(SEED)
            low = (data["next", "observation"][..., 0] < FALLEN).numpy()
            steps = np.where(low.any(-1), low.argmax(-1), low.shape[-1])
            falls[controller, bias] = steps * dt
            rows += [
                {
                    "l1": controller,
                    "bias": bias,
                    "episode": episode,
                    "return": round(value, 3),
                    "standing_s": round(float(step * dt), 3),
                    "fell": int(step < low.shape[-1]),
                }
                for episode, (value, step) in enumerate(
                    zip(episode_returns(data).tolist(), steps, strict=True)
                )
            ]
            print(f"bias {bias:g}, L1 {controller}: {int(low.any(-1).sum())} of {EPISODES} fell")
    return rows, falls


def table(rows: Sequence[Row]) -> list[Row]:
    """One row per bias and controller."""
    lines = []
    for bias in BIASES:
        for controller in CONTROLLERS:
            cell = [row for row in rows if (row["l1"], row["bias"]) == (controller, bias)]
            returns = np.array([row["return"] for row in cell])
            lines.append(
                {
                    "bias": f"{bias:g}",
                    "L1": controller,
                    "return, median [quartiles]": "{:.0f} [{:.0f}, {:.0f}]".format(
                        *np.percentile(returns, (50, 25, 75))
                    ),
                    "fallen": f"{sum(row['fell'] for row in cell)} of {len(cell)}",
                    "standing, median": f"{np.median([row['standing_s'] for row in cell]):.2f} s",
                }
            )
    return lines


def draw(rows: Sequence[Row], falls: dict[tuple[str, float], np.ndarray], horizon: float) -> None:
    """How many still stand, over time; and returns, one dot per episode."""
    figure, axes = plt.subplots(2, len(BIASES), figsize=(10, 5.2), sharey="row")
    rng = np.random.default_rng(0)
    for (above, below), bias in zip(axes.T, BIASES, strict=True):
        for place, (controller, color) in enumerate(CONTROLLERS.items()):
            times = np.sort(falls[controller, bias])
            standing = 1 - np.arange(len(times) + 1) / len(times)
            edges = np.concatenate([[0], np.minimum(times, horizon), [horizon]])
            above.stairs(100 * standing, edges, baseline=None, color=color, lw=2, label=controller)
            values = [r["return"] for r in rows if (r["l1"], r["bias"]) == (controller, bias)]
            jitter = place + rng.uniform(-0.2, 0.2, len(values))
            below.plot(jitter, values, "o", ms=3, alpha=0.5, color=color)
            below.plot([place - 0.3, place + 0.3], [np.median(values)] * 2, color=color, lw=2)
        above.set(title=f"bias {bias:g}", xlabel="time, s", xlim=(0, horizon), ylim=(-3, 103))
        below.set_xticks(range(len(CONTROLLERS)), list(CONTROLLERS))
    axes[0, 0].set_ylabel("episodes still standing, %")
    axes[1, 0].set_ylabel("return")
    axes[0, -1].legend(loc="upper right", fontsize="small")
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle("Hopper, a frozen METRPO policy under a constant actuator bias (bound: 1)")
    figure.tight_layout()
    figure.savefig(HERE / "hopper.png", dpi=110)


def main(run: Path) -> None:
    """All of it."""
    trained = load_run(run)
    rows, falls = measure(trained)
    write_table(HERE / "hopper.csv", rows)
    steps = trained.algorithm.iteration * trained.algorithm.collection.frames
    note = (
        f"One training seed ({trained.recipe.seed}), METRPO without L1 after {steps:,} real steps "
        f"and a first batch of random ones; {EPISODES} episodes of the mean action per row."
    ).replace(",", " ", 1)
    (HERE / "hopper.md").write_text(f"{markdown(table(rows))}\n\n{note}\n")
    task = trained.algorithm.task
    draw(rows, falls, task.horizon * task.dt)
    output = HERE / "hopper"
    output.mkdir(exist_ok=True)
    cells = [condition(controller, -0.4) for controller in CONTROLLERS]
    write_filmstrip(trained, cells, "bias", SEED, output)
    print(f"Table: {HERE / 'hopper.md'}, figures: {HERE / 'hopper.png'} and {output}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
