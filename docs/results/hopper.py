"""Hopper under an actuator bias: what each controller makes of it, and how it looks.

    torchrl-l1 run metrpo/hopper l1=off threads=1 run_dir=runs/hopper --resume
    python docs/results/hopper.py [runs/hopper]

Writes `hopper.csv` (one row per episode), `hopper.md`, `hopper.png` and the folder `hopper` with
the filmstrip beside this file: 24 episodes of the policy's mean action per controller and bias. A
hopper is upright until its torso is below 0.7 m, which is no end of the task's episodes. Without a
run, table and figure are written again from `hopper.csv`.
"""

from __future__ import annotations

import csv
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
from torchrl_l1.report.style import color

HERE = Path(__file__).parent
CONTROLLERS = {l1: color(0, l1) for l1 in ("off", "paper", "robust", "oracle")}
BIASES = (0.0, -0.4, 0.4)
FALLEN = 0.7
EPISODES, SEED = 24, 0
Row = dict[str, Any]


def condition(controller: str, bias: float) -> Condition:
    """One cell of the evaluation."""
    return Condition(l1=controller, policy="deterministic", disturbances={"bias": bias})


def measure(trained: TrainedRun) -> list[Row]:
    """Rows of single episodes."""
    rows = []
    algorithm = trained.algorithm
    dt, frames = algorithm.task.dt, algorithm.collection.frames
    trained_on = {"seed": trained.recipe.seed, "real_steps": (algorithm.iteration + 1) * frames}
    for bias in BIASES:
        for controller in CONTROLLERS:
            collection = make_collection(trained, condition(controller, bias), EPISODES)
            data = collection.evaluate(SEED)
            low = (data["next", "observation"][..., 0] < FALLEN).numpy()
            steps = np.where(low.any(-1), low.argmax(-1), low.shape[-1])
            rows += [
                trained_on
                | {
                    "l1": controller,
                    "bias": bias,
                    "episode": episode,
                    "return": round(value, 3),
                    "upright_s": round(float(step * dt), 3),
                }
                for episode, (value, step) in enumerate(
                    zip(episode_returns(data).tolist(), steps, strict=True)
                )
            ]
            print(f"bias {bias:g}, L1 {controller}: {episode_returns(data).median():.0f}")
    return rows


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
                    "upright, median": f"{np.median([row['upright_s'] for row in cell]):.2f} s",
                }
            )
    return lines


def draw(rows: Sequence[Row]) -> None:
    """Returns, one dot per episode, and their medians."""
    figure, axes = plt.subplots(1, len(BIASES), figsize=(9, 3.2), sharey=True)
    rng = np.random.default_rng(0)
    for axis, bias in zip(axes, BIASES, strict=True):
        for place, (controller, colour) in enumerate(CONTROLLERS.items()):
            values = [r["return"] for r in rows if (r["l1"], r["bias"]) == (controller, bias)]
            jitter = place + rng.uniform(-0.2, 0.2, len(values))
            axis.plot(jitter, values, "o", ms=3, alpha=0.5, color=colour)
            axis.plot([place - 0.3, place + 0.3], [np.median(values)] * 2, color=colour, lw=2)
        axis.set_title(f"bias {bias:g}")
        axis.set_xticks(range(len(CONTROLLERS)), list(CONTROLLERS))
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(axis="y", alpha=0.3)
    axes[0].set_ylabel("return of an episode")
    figure.suptitle(
        f"Hopper: one frozen METRPO policy (seed {rows[0]['seed']}) under a constant actuator bias "
        f"(bound 1): {EPISODES} episodes, bar: median",
        fontsize=10,
    )
    figure.tight_layout()
    figure.savefig(HERE / "hopper.png", dpi=110)


def read(file: Path) -> list[Row]:
    """Rows of an earlier measurement."""
    texts = ("seed", "real_steps", "l1", "episode")
    with file.open(newline="") as handle:
        return [
            {name: value if name in texts else float(value) for name, value in row.items()}
            for row in csv.DictReader(handle)
        ]


def filmstrip(trained: TrainedRun) -> None:
    """The four controllers at a bias, from the same reset."""
    output = HERE / "hopper"
    output.mkdir(exist_ok=True)
    cells = [condition(controller, -0.4) for controller in CONTROLLERS]
    write_filmstrip(trained, cells, "bias", SEED, output)


def main(run: Path | None = None) -> None:
    """All of it, or of the rows that are there."""
    if run is not None:
        trained = load_run(run)
        write_table(HERE / "hopper.csv", measure(trained))
        filmstrip(trained)
    rows = read(HERE / "hopper.csv")
    note = (
        f"One training seed ({rows[0]['seed']}), METRPO without L1 after {rows[0]['real_steps']} "
        f"real steps; {EPISODES} episodes of the mean action per row. Upright: until the torso is "
        f"below {FALLEN} m for the first time."
    )
    (HERE / "hopper.md").write_text(f"{markdown(table(rows))}\n\n{note}\n")
    draw(rows)
    print(f"Table: {HERE / 'hopper.md'}, figures: {HERE / 'hopper.png'} and {HERE / 'hopper'}")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit(__doc__)
    main(*map(Path, sys.argv[1:]))
