"""How good a model must be for L1 to be of use, and by which measure one sees it.

    python docs/results/fit_quality.py [--quick] [FOLDER]

Fits models of one quality after another (few data, short fits, noisy sensors, hardly any
excitation) to two pendulums, deploys a hand-written policy under an actuator bias with L1 off and
on, and writes runs.csv, measures.md, bands.md and quality.png into FOLDER, by default
`fit_quality` beside this file; a plant whose rows are there is not run again. About a quarter of
an hour on one core.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.ticker import LogLocator
from scipy.linalg import solve_discrete_are
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, GymEnv, SerialEnv, Transform, TransformedEnv

from torchrl_l1.control import L1Config, L1Transform
from torchrl_l1.dynamics import EnsembleDynamics, fit_dynamics
from torchrl_l1.envs import ActuatorBias, make_env
from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown
from torchrl_l1.report.style import color, grid, legend_below, save

Row = dict[str, str | float]
Law = Callable[[Tensor], Tensor]
EPISODES, STEPS = 10, 200
ROWS = (30, 100, 1000, 5000)
EXCITATIONS = (
    0.0,
    0.03,
    0.3,
    1.0,
)  # half-width of noise on the action, of its bound
NOISES = (0.0, 0.2, 1.0)  # of the sensors in the data, of the change in one step
FITS = (10, 100, 2000)  # gradient steps
SEEDS = (0, 1)
ARMS = ("paper", "robust")
MEASURES = {
    "gain_spread": "disagreement on the gain",
    "input_error": "error as an input",
    "explained_mean": "change explained, mean of the entries",
    "explained_least": "change explained, least of the entries",
    "after_ten_steps": "error after 10 steps / spread, worst entry",
}


@dataclass(frozen=True)
class Plant:
    """A plant, its policy and what a bias costs there.

    Attributes:
        name: of the plant.
        make: environments with transforms, by the number of them and a seed.
        dt: sampling time, s.
        bound: of the action.
        bias: the actuator bias in the deployment.
        epsilon: tolerance of the switching law.
        law: the policy.
        cost: of observations ``(..., n)``, ``(...,)``.
        settling: steps before the cost counts.
        grid: rows, excitations, noises and seeds of the models.
    """

    name: str
    make: Callable[..., TransformedEnv]
    dt: float
    bound: float
    bias: float
    epsilon: float
    law: Law
    cost: Law
    settling: int = 0
    grid: tuple[Sequence[Any], ...] = (ROWS, EXCITATIONS, NOISES, SEEDS)


def inverted_pendulum() -> Plant:
    """A pole on a cart, with a linear-quadratic regulator."""

    def make(num_envs: int, seed: int, *transforms: Transform) -> TransformedEnv:
        return make_env("inverted_pendulum", num_envs, seed=seed, extra_transforms=transforms)

    torch.manual_seed(0)
    near = make(100, 0).rollout(5)
    x, u, after = (
        near[key].flatten(0, 1).double()
        for key in ("observation", "action", ("next", "observation"))
    )
    matrix = torch.linalg.lstsq(torch.cat([x, u], -1), after).solution.T.numpy()
    a, b = matrix[:, :4], matrix[:, 4:]
    p = solve_discrete_are(a, b, np.diag([1.0, 1.0, 0.1, 0.1]), np.eye(1))
    gain = torch.from_numpy(np.linalg.solve(np.eye(1) + b.T @ p @ b, b.T @ p @ a)).float()
    return Plant(
        "inverted pendulum",
        make,
        0.04,
        3.0,
        1.0,
        1.0,
        lambda x: (-x @ gain.T).clamp(-3, 3),
        lambda x: x[..., :2].square().sum(-1).clamp(max=10.0),
    )


def pendulum() -> Plant:
    """Gymnasium's torque-limited pendulum, swung up by its energy and held by a linear law."""

    def make(num_envs: int, seed: int, *transforms: Transform) -> TransformedEnv:
        base = SerialEnv(num_envs, partial(GymEnv, "Pendulum-v1"))
        env = TransformedEnv(base, Compose(*transforms))
        env.set_seed(seed)
        return env

    def law(x: Tensor) -> Tensor:
        cos, sin, rate = x[..., :1], x[..., 1:2], x[..., 2:]
        energy = rate.square() / 6 + 5 * (cos - 1)
        near = (cos > 0.95) & (rate.abs() < 2.5)
        return torch.where(near, -12 * sin - 3 * rate, -5 * energy * rate).clamp(-2, 2)

    return Plant(
        "Pendulum-v1",
        make,
        0.05,
        2.0,
        0.5,
        0.3,
        law,
        lambda x: torch.atan2(x[..., 1], x[..., 0]).square(),
        STEPS // 2,
        ((300,), (0.0, 0.3), (0.0, 1.0), (0,)),
    )


def actor(plant: Plant, excitation: float = 0.0) -> TensorDictModule:
    """The policy, with uniform noise of so much of the bound."""

    def act(x: Tensor) -> Tensor:
        u = plant.law(x)
        noise = (2 * torch.rand_like(u) - 1) * excitation * plant.bound
        return (u + noise).clamp(-plant.bound, plant.bound)

    return TensorDictModule(act, ["observation"], ["action"])


def record(plant: Plant, rows: int, excitation: float, noise: float, seed: int) -> TensorDict:
    """Transitions ``[10, rows / 10]`` of the undisturbed plant, seen by noisy sensors."""
    torch.manual_seed(seed)
    steps = max(3, min(STEPS, rows // EPISODES))
    count = max(1, rows // steps)
    data = plant.make(count, seed).rollout(
        steps, actor(plant, excitation), break_when_any_done=False
    )
    data = data.select("observation", "action", ("next", "observation")).detach()
    x = torch.cat([data["observation"], data["next", "observation"][:, -1:]], 1)
    scale = (x[:, 1:] - x[:, :-1]).flatten(0, 1).std(0)
    x = x + noise * scale * torch.randn_like(x)
    data["observation"], data["next", "observation"] = x[:, :-1].clone(), x[:, 1:].clone()
    return data


@torch.no_grad()
def deployed(
    plant: Plant, bias: float, model: EnsembleDynamics | None = None, config: L1Config | None = None
) -> float:
    """Mean cost per step over the episodes."""
    transforms: list[Transform] = [ActuatorBias(bias)] if bias else []
    if model is not None:
        transforms.append(L1Transform(model, config))
    env = plant.make(EPISODES, 7, *transforms)
    data = env.rollout(STEPS, actor(plant), break_when_any_done=False)
    return float(plant.cost(data["next", "observation"][:, plant.settling :]).mean())


def measures(model: EnsembleDynamics) -> Row:
    """What a fit knows of itself, each as one number for all entries."""
    quality = model.quality
    assert quality is not None
    explained = [share for share in quality.explained if not math.isnan(share)]
    errors = zip(quality.open_loop[10], quality.spread, strict=True)
    return {
        "gain_spread": quality.gain_spread,
        "input_error": max(quality.input_error),
        "explained_mean": float(np.mean(explained)),
        "explained_least": min(explained),
        "after_ten_steps": max(error / spread for error, spread in errors),
    }


def cells(plant: Plant, quick: bool) -> Iterator[tuple[int, float, float, int, int]]:
    """Rows, excitation, noise, seed and gradient steps."""
    if quick:
        yield from [(300, 0.3, 0.0, 0, 300), (300, 0.3, 0.0, 0, 5)]
        return
    rows, excitations, _, seeds = plant.grid
    yield from ((*cell, FITS[-1]) for cell in itertools.product(*plant.grid))
    for fit, excitation, seed in itertools.product(FITS[:-1], excitations, seeds):
        yield rows[-1], excitation, 0.0, seed, fit


def runs(plant: Plant, quick: bool) -> Iterator[Row]:
    """One row per model, with the share of what the bias costs that L1 regains."""
    clean, off = deployed(plant, 0.0), deployed(plant, plant.bias)
    configs = {
        "paper": L1Config.paper(plant.dt, epsilon=plant.epsilon),
        "robust": L1Config.robust(plant.dt),
    }
    for count, excitation, noise, seed, fit in cells(plant, quick):
        data = record(plant, count, excitation, noise, seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = fit_dynamics(
                data, hidden=(64, 64), max_gradient_steps=fit, max_epochs=1000, seed=seed
            )
        row: Row = {"plant": plant.name, "rows": count, "excitation": excitation}
        row |= {"noise": noise, "fit": fit, "seed": seed, **measures(model)}
        for name, config in configs.items():
            row[name] = (off - deployed(plant, plant.bias, model, config)) / (off - clean)
        yield row


def separation(values: Sequence[float], helps: Sequence[bool]) -> float:
    """How often a measure is larger where L1 helps than where it does not, or the reverse."""
    known = [pair for pair in zip(values, helps, strict=True) if not math.isnan(pair[0])]
    ours, others = ([value for value, one in known if one is which] for which in (True, False))
    if not ours or not others:
        return math.nan
    pairs = list(itertools.product(ours, others))
    share = sum((one > other) + 0.5 * (one == other) for one, other in pairs) / len(pairs)
    return max(share, 1 - share)


def table(rows: Sequence[Row]) -> str:
    """How well each measure tells where L1 regains more than half of what the bias costs."""
    lines = []
    for measure, words in MEASURES.items():
        line = {"Measure": words}
        for arm in ARMS:
            values = [float(row[measure]) for row in rows]
            helps = [float(row[arm]) > 0.5 for row in rows]
            line[f"`{arm}`"] = f"{separation(values, helps):.2f}"
        lines.append(line)
    return markdown(lines) + "\n"


def bands(rows: Sequence[Row]) -> str:
    """In how many cases L1 regains more than half, by the disagreement on the gain."""
    lines = []
    for low, high in itertools.pairwise((0.0, 0.1, 0.2, 0.3, 0.5, math.inf)):
        inside = [row for row in rows if low <= float(row["gain_spread"]) < high]
        name = f"{100 * low:.0f} to {100 * high:.0f} %" if high < math.inf else "more"
        line = {"Disagreement on the gain": name, "Models": f"{len(inside)}"}
        for arm in ARMS:
            line[f"`{arm}` helps"] = f"{sum(float(row[arm]) > 0.5 for row in inside)}"
        lines.append(line)
    return markdown(lines) + "\n"


def draw(rows: Sequence[Row], file: Path) -> None:
    """What L1 regains against the three measures that the report has."""
    shown = ("gain_spread", "input_error", "explained_mean")
    plants = list(dict.fromkeys(str(row["plant"]) for row in rows))
    figure, axes = grid(len(plants) * len(shown), len(shown), 3.2, 2.6)
    for axis, (plant, measure) in zip(axes, itertools.product(plants, shown), strict=True):
        of_plant = [row for row in rows if row["plant"] == plant]
        for arm, marker in zip(ARMS, "ox", strict=True):
            x = [max(-1.0, float(row[measure])) for row in of_plant]
            y = [max(-1.0, float(row[arm])) for row in of_plant]
            axis.plot(x, y, marker, color=color(1 + ARMS.index(arm)), label=f"L1 {arm}", ms=4)
        if measure == "explained_mean":
            axis.set_xlim(-1.05, 1.05)
        else:
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(numticks=5))
        axis.axhline(0, color="0.6", lw=0.8)
        axis.set_title(plant, fontsize=9)
        least = " (at least -1)" if measure == "explained_mean" else ""
        axis.set_xlabel(MEASURES[measure].split(",")[0] + least, fontsize=8)
        axis.set_ylabel("share regained (at least -1)", fontsize=8)
    legend_below(figure, axes)
    save(figure, file)


PLANTS = {"inverted pendulum": inverted_pendulum, "Pendulum-v1": pendulum}
FOLDER = Path(__file__).with_suffix("")


def main(folder: Path = FOLDER, quick: bool = False) -> None:
    """Run, or with rows in the folder already draw those."""
    folder.mkdir(exist_ok=True, parents=True)
    file = folder / "runs.csv"
    rows: list[Row] = []
    if file.exists():
        with file.open(newline="") as handle:
            rows = [dict(row) for row in csv.DictReader(handle)]
    done = {row["plant"] for row in rows}
    for name, make in PLANTS.items():
        if name not in done:
            for row in runs(make(), quick):
                rows.append(row)
                write_table(file, rows)
    (folder / "measures.md").write_text(table(rows))
    (folder / "bands.md").write_text(bands(rows))
    draw(rows, folder / "quality.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    main(arguments.folder, arguments.quick)
