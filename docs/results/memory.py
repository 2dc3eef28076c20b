"""Memory of a process that steps 4096 inverted pendulums through L1: does it grow?

    python docs/results/memory.py [STEPS]

Writes `memory.csv` and `memory.png` beside this file: the resident set of the process, eager,
without L1, with the paper's controller and with the robust one, each in a process of its own.
"""

from __future__ import annotations

import csv
import multiprocessing
import os
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torchrl.envs.utils import RandomPolicy
from tqdm import tqdm

from torchrl_l1 import EnsembleDynamics, L1Config, L1Transform
from torchrl_l1.envs import get_task, make_env
from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.style import color

HERE = Path(__file__).parent
ENVIRONMENTS = 4096
TASK = "inverted_pendulum"  # its simulation takes the least time
CONTROLLERS = ("off", "paper", "robust")
EVERY = 20


def resident_mebibytes() -> float:
    """What the process holds in memory now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def controller(name: str) -> list[L1Transform]:
    """The transforms of one of the arms, with a small model that has seen no data."""
    task = get_task(TASK)
    bounds = {"action_low": task.action_low, "action_high": task.action_high}
    if name == "off":
        return []
    model = EnsembleDynamics(task.observation_dim, task.action_dim, members=5, hidden=(32, 32))
    made = L1Config.robust if name == "robust" else L1Config.paper
    return [L1Transform(model.eval(), made(task.dt, **bounds))]


def measure(name: str, steps: int) -> list[dict[str, float | str]]:
    """The resident set every few steps."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = make_env(TASK, ENVIRONMENTS, seed=0, extra_transforms=controller(name))
    policy = RandomPolicy(env.full_action_spec)
    rows: list[dict[str, float | str]] = []
    with torch.no_grad():
        state = env.reset()
        for step in tqdm(range(steps + 1), desc=name):
            if step % EVERY == 0:
                rows.append({"l1": name, "step": step, "mebibytes": round(resident_mebibytes(), 1)})
            _, state = env.step_and_maybe_reset(policy(state))
    return rows


def main() -> None:
    """Measure the arms in turn, then draw."""
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    fresh = multiprocessing.get_context("spawn")
    rows = []
    for name in CONTROLLERS:
        with fresh.Pool(1) as pool:
            rows += pool.apply(measure, (name, steps))
    write_table(HERE / "memory.csv", rows)
    draw()


def draw() -> None:
    """The figure, from the file."""
    with (HERE / "memory.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    figure, ax = plt.subplots(figsize=(7, 3.2), layout="constrained")
    for name in CONTROLLERS:
        points = [(int(r["step"]), float(r["mebibytes"])) for r in rows if r["l1"] == name]
        ax.plot(*zip(*points, strict=True), color=color(0, name), label=f"L1 {name}")
        half = [value for step, value in points if step >= points[-1][0] / 2]
        print(f"L1 {name}: {half[0]:.0f} MiB at half of the steps, {half[-1]:.0f} MiB at the end")
    ax.set_xlabel(f"steps of {ENVIRONMENTS} environments")
    ax.set_ylabel("resident set, MiB")
    ax.set_ylim(0, 1.15 * max(float(row["mebibytes"]) for row in rows))
    ax.legend(loc="lower right")
    figure.savefig(HERE / "memory.png", dpi=110)
    print(f"Figure: {HERE / 'memory.png'}")


if __name__ == "__main__":
    main()
