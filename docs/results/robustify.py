"""A PPO policy of Stable-Baselines3 with L1 around it: bias on the pendulum's motor.

    python docs/results/robustify.py [FOLDER]

Needs the extra `sb3`. Trains PPO with its default settings on InvertedPendulum-v5, looks at what
each policy withstands by itself (`robustify/policies.csv` and `.md`), and runs
`torchrl-l1 robustify` on one that works without a bias and falls with one:
`robustify/evaluation.csv`, `.png` and `table.md`. FOLDER, `runs/ppo` if none is given, keeps the
policies; those that are there are not trained again.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
import sys
import time
from pathlib import Path
from statistics import median

import gymnasium
import numpy as np
import torch

from torchrl_l1.cli import main
from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown

HERE = Path(__file__).with_name("robustify")
ENV = "InvertedPendulum-v5"
SEEDS = (0, 1, 2)
THOUSANDS = (20, 30, 40, 50, 60)
BIASES = (0.0, 0.5, 1.0, 1.5)
SHOWN = (2, 30)
EPISODES = 3


def file(folder: Path, seed: int, thousands: int) -> Path:
    """Where a policy is kept."""
    return folder / f"ppo_{seed}_{thousands}.zip"


def train(folder: Path) -> None:
    """Train each seed, and keep the policy at several times."""
    from stable_baselines3 import PPO

    folder.mkdir(parents=True, exist_ok=True)
    for seed in SEEDS:
        if all(file(folder, seed, k).exists() for k in THOUSANDS):
            continue
        model = PPO("MlpPolicy", ENV, seed=seed, device="cpu")
        for k in THOUSANDS:
            model.learn(1000 * k - model.num_timesteps, reset_num_timesteps=False)
            model.save(file(folder, seed, k))


def steps_without_l1(policy: Path, bias: float) -> int:
    """Median length of a few episodes, by Gymnasium and Stable-Baselines3 alone."""
    from stable_baselines3 import PPO

    model, env, lengths = PPO.load(policy, device="cpu"), gymnasium.make(ENV), []
    for seed in range(EPISODES):
        observation, _ = env.reset(seed=seed)
        done = False
        lengths.append(0)
        while not done:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, _ = env.step(np.clip(action + bias, -3, 3))
            done = terminated or truncated
            lengths[-1] += 1
    return int(median(lengths))


def policies(folder: Path) -> None:
    """What policies of several trainings and lengths withstand without L1."""
    rows = [
        {"seed": seed, "training_steps": 1000 * k, "bias": bias}
        | {"steps_median": steps_without_l1(file(folder, seed, k), bias)}
        for seed in SEEDS
        for k in THOUSANDS
        for bias in BIASES
    ]
    write_table(HERE / "policies.csv", rows)


def policies_table() -> None:
    """The table of the policies, of the CSV."""
    with (HERE / "policies.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    lines = []
    for k in THOUSANDS:
        line = {"training steps": f"{1000 * k}"}
        for bias in BIASES:
            found = [
                row["steps_median"]
                for row in rows
                if int(row["training_steps"]) == 1000 * k and float(row["bias"]) == bias
            ]
            line[f"bias {bias:g}"] = ", ".join(found)
        lines.append(line)
    words = f"Without L1: median number of steps of {EPISODES} episodes"
    words += f", for each of {len(SEEDS)} seeds."
    (HERE / "policies.md").write_text(f"{words}\n\n{markdown(lines)}\n")


def robustify(folder: Path, output: Path) -> None:
    """Run the command, and keep what it writes."""
    started = (time.perf_counter(), time.process_time())
    biases = [f"{bias:g}" for bias in BIASES]
    policy = f"sb3:{file(folder, *SHOWN)}"
    main(["robustify", f"gymnasium/{ENV}", "--policy", policy, "--bias", *biases,
          "--output", str(output)])  # fmt: skip
    wall, busy = time.perf_counter() - started[0], time.process_time() - started[1]
    keep(output, busy)
    print(f"{wall:.0f} s, {busy:.0f} s of one core")


def keep(output: Path, busy: float) -> None:
    """Copy table and chart of a finished command."""
    for name in ("evaluation.csv", "evaluation.png"):
        shutil.copyfile(output / name, HERE / name)
    page = (output / "README.md").read_text()
    table = re.search(r"^Median return.*?(?=^!\[)", page, re.DOTALL | re.MULTILINE)
    assert table is not None
    (HERE / "table.md").write_text(
        f"{table[0].strip()}\n\nThe command took {busy:.0f} s of one core.\n"
    )


if __name__ == "__main__":
    # One core is what is counted.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    place = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("runs/ppo")
    HERE.mkdir(exist_ok=True)
    train(place)
    policies(place)
    policies_table()
    robustify(place, place / "robustify")
