"""PETS on mbrl-lib's own continuous cartpole: mbrl-lib's beside ours, by real steps and seconds.

    python docs/results/mbrl_cartpole.py FOLDER [SEED ...]

Runs both in turn, one thread each, mbrl-lib 0.2.0 with the settings that it ships for this
environment (`overrides/pets_cartpole.yaml`) in the peers' environment of the benchmarks, ours with
the recipe `pets/any`; both are given the reward and the end of an episode as functions. Run
directories are in FOLDER. Both begin with 200 random steps; then mbrl-lib has 200 planned ones and
what is left of an episode, ours two episodes. Writes `mbrl_cartpole/episodes.csv`, `.md` and
`.png` beside this file, and without FOLDER the latter two again from the former. An episode is
over when the pole falls or after 200 steps, so that 200 is the best return; seconds are of the
processor, imports included.
"""

from __future__ import annotations

import csv
import importlib.util
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium

HERE = Path(__file__).with_suffix("")
SEEDS = (0, 1, 2)
RANDOM, STEPS, LONGEST = 200, 200, 200  # of both; planned ones of mbrl-lib; of an episode
LIMITS = {0: 2.4, 2: 0.2094395102393195}  # of the cart, m, and of the pole, rad
COLOURS = {"mbrl-lib": "#999999", "ours": "#0072b2"}
Row = dict[str, Any]


def make_env() -> gymnasium.Env[Any, Any]:
    """The environment, from mbrl-lib's file itself: the package needs more than is here."""
    root = Path(__file__).parents[2] / "build/peers/lib"
    (file,) = root.glob("python*/site-packages/mbrl/env/cartpole_continuous.py")
    spec = importlib.util.spec_from_file_location("mbrl_cartpole_continuous", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    class CartPole(module.CartPoleEnv):  # type: ignore[name-defined]
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return super().reset(seed=seed)  # it does not know options, which wrappers pass on

    return gymnasium.wrappers.TimeLimit(CartPole(), LONGEST)


def fallen(next_observation: Any) -> Any:
    """Whether an episode is over."""
    over = [next_observation[..., entry].abs() > limit for entry, limit in LIMITS.items()]
    return over[0] | over[1]


def reward(observation: Any, action: Any, next_observation: Any) -> Any:
    """One for a pole that stands."""
    return (~fallen(next_observation)).to(next_observation.dtype)


class Episodes(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps what each episode returned."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.found: list[Row] = []
        self.steps, self.total = 0, 0.0

    def step(self, action: Any) -> Any:
        """As that of the environment."""
        answer = self.env.step(action)
        self.steps += 1
        self.total += float(answer[1])
        if answer[2] or answer[3]:
            self.found.append({"real_steps": self.steps, "return": self.total})
            self.total = 0.0
        return answer

    def reset(self, **options: Any) -> Any:
        """As that of the environment; what was broken off counts for nothing."""
        self.total = 0.0
        return self.env.reset(**options)


def peer(seed: int, folder: Path) -> None:
    """mbrl-lib's run, in its own interpreter."""
    import mbrl.algorithms.pets
    import mbrl.env.reward_fns
    import mbrl.env.termination_fns
    import numpy as np
    import torch
    from omegaconf import OmegaConf

    torch.set_num_threads(1)
    np.random.seed(seed)
    torch.manual_seed(seed)
    shipped = Path(mbrl.__file__).parent / "examples/conf"
    parts = {
        "algorithm": "algorithm/pets.yaml",
        "dynamics_model": "dynamics_model/gaussian_mlp_ensemble.yaml",
        "overrides": "overrides/pets_cartpole.yaml",
    }
    config: Any = {name: OmegaConf.load(shipped / file) for name, file in parts.items()}
    config["overrides"]["num_steps"] = STEPS
    settings = config["overrides"]
    config["action_optimizer"] = {  # what the examples' own action_optimizer/cem.yaml makes of them
        "_target_": "mbrl.planning.CEMOptimizer",
        "num_iterations": settings["cem_num_iters"],
        "elite_ratio": settings["cem_elite_ratio"],
        "population_size": settings["cem_population_size"],
        "alpha": settings["cem_alpha"],
        "lower_bound": "???",
        "upper_bound": "???",
        "return_mean_elites": True,
        "device": "cpu",
        "clipped_normal": settings["cem_clipped_normal"],
    }
    config |= {"seed": seed, "device": "cpu", "debug_mode": False, "log_frequency_agent": 1000}
    # Hydra made nothing of what is inside when mbrl-lib was written.
    for part in (config["dynamics_model"], config["algorithm"]["agent"]):
        part["_recursive_"] = False
    env = Episodes(make_env())
    env.reset(seed=seed)
    env.action_space.seed(seed)
    folder.mkdir(parents=True, exist_ok=True)
    mbrl.algorithms.pets.train(
        env,
        mbrl.env.termination_fns.cartpole,
        mbrl.env.reward_fns.cartpole,
        OmegaConf.create(config),
        silent=True,
        work_dir=str(folder),
    )
    write(folder / "episodes.csv", env.found)


def ours(seed: int, folder: Path) -> list[Row]:
    """Our run, by its command."""
    here = Path(__file__)
    command = [
        str(Path(sys.executable).with_name("torchrl-l1")),
        *("run", "pets/any", "l1=off", "threads=1", "wandb.mode=disabled", f"seed={seed}"),
        *(f"task={here}:make_env", f"reward={here}:reward", f"termination={here}:fallen"),
        *("dt=0.02", f"horizon={LONGEST}", "outer_iterations=2", f"run_dir={folder}"),
    ]
    subprocess.run(command, check=True)
    return [
        {"real_steps": int(row["real_steps"]), "return": float(row["return_mean"])}
        for row in read(folder / "metrics.csv")
    ]


def compare(folder: Path, seeds: tuple[int, ...]) -> None:
    """Both, seed by seed."""
    from benchmarks.peers import environment

    rows: list[Row] = []
    for seed in seeds:
        for name in COLOURS:
            place, before = folder / f"{name}_{seed}", seconds_of_children()
            if name == "ours":
                found = ours(seed, place)
            else:
                command = [str(environment()), __file__, "--peer", str(seed), str(place)]
                subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
                found = read(place / "episodes.csv")
            seconds = round(seconds_of_children() - before, 1)
            rows += [{"library": name, "seed": seed, **row, "seconds": seconds} for row in found]
    HERE.mkdir(exist_ok=True)
    write(HERE / "episodes.csv", rows)


def seconds_of_children() -> float:
    """Processor time of all that has been run and is over."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def read(file: Path) -> list[Row]:
    """Rows of a table."""
    with file.open(newline="") as handle:
        return list(csv.DictReader(handle))


def write(file: Path, rows: list[Row]) -> None:
    """A table."""
    with file.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def draw() -> None:
    """Table and figure, from the episodes."""
    import matplotlib.pyplot as plt

    from torchrl_l1.report.page import markdown

    rows, lines = read(HERE / "episodes.csv"), []
    figure, ax = plt.subplots(figsize=(7, 3.2), layout="constrained")
    for name, colour in COLOURS.items():
        for seed in sorted({row["seed"] for row in rows}):
            mine = [row for row in rows if (row["library"], row["seed"]) == (name, seed)]
            steps = [int(row["real_steps"]) for row in mine]
            returns = [float(row["return"]) for row in mine]
            ax.plot(steps, returns, ".-", color=colour, label=name if seed == "0" else None)
            planned = [r for s, r in zip(steps, returns, strict=True) if s > RANDOM]
            seconds = float(mine[0]["seconds"])
            lines.append(
                {
                    "library": name,
                    "seed": seed,
                    "real steps": steps[-1],
                    "returns of planned episodes": ", ".join(f"{value:.0f}" for value in planned),
                    "processor seconds": f"{seconds:.0f}",
                    "per planned step": f"{seconds / (steps[-1] - RANDOM):.2f}",
                }
            )
    ax.axvline(RANDOM, color="0.8", lw=1, zorder=0)
    ax.annotate("planned", (RANDOM + 5, 185), color="0.4")
    ax.annotate("random", (RANDOM - 5, 185), color="0.4", ha="right")
    ax.set_xlabel("real steps")
    ax.set_ylabel("return of an episode")
    ax.set_ylim(0, 1.05 * LONGEST)
    ax.legend(loc="center right")
    figure.savefig(HERE.with_suffix(".png"), dpi=110)
    HERE.with_suffix(".md").write_text(markdown(lines) + "\n")
    print(f"Table: {HERE.with_suffix('.md')}\nFigure: {HERE.with_suffix('.png')}")


def main(*arguments: str) -> None:
    """Run what is asked for, then draw."""
    if arguments and arguments[0] == "--peer":
        peer(int(arguments[1]), Path(arguments[2]))
        return
    if arguments:
        compare(Path(arguments[0]), tuple(map(int, arguments[1:])) or SEEDS)
    draw()


if __name__ == "__main__":
    main(*sys.argv[1:])
