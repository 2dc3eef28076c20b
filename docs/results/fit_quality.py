"""How good a model must be for L1 to be of use, and by which measure one sees it.

    python docs/results/fit_quality.py [--quick] [FOLDER]

Fits models of one quality after another (few data, short fits, noisy sensors, hardly any
excitation) to two pendulums, deploys a hand-written policy under an actuator bias with L1 off and
on, and writes runs.csv, table.md and quality.png into FOLDER, by default `fit_quality` beside this
file. About ten minutes on one core.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, EnvBase, GymEnv, TransformedEnv

from torchrl_l1.control import L1Config, L1Transform
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, fit_dynamics
from torchrl_l1.envs import ActuatorBias, make_env
from torchrl_l1.experiment.run_directory import write_table
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
)  # half-width of what is added to the policy's action, of its bound
NOISES = (0.0, 0.2, 1.0)  # of the sensors in the data, of the change in one step
FITS = (10, 100, 2000)  # gradient steps
SEEDS = (0, 1)


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
    """

    name: str
    make: Callable[..., TransformedEnv]
    dt: float
    bound: float
    bias: float
    epsilon: float
    law: Law
    cost: Law


def inverted_pendulum() -> Plant:
    """A pole on a cart, with a linear-quadratic regulator."""

    def make(num_envs: int, seed: int, *transforms: object) -> TransformedEnv:
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

    def make(num_envs: int, seed: int, *transforms: object) -> TransformedEnv:
        env = TransformedEnv(GymEnv("Pendulum-v1", num_envs=num_envs), Compose(*transforms))
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
    transforms: list[object] = [ActuatorBias(bias)] if bias else []
    if model is not None:
        transforms.append(L1Transform(model, config))
    env = plant.make(EPISODES, 7, *transforms)
    data = env.rollout(STEPS, actor(plant), break_when_any_done=False)
    return float(plant.cost(data["next", "observation"]).mean())


@torch.no_grad()
def measures(model: EnsembleDynamics, data: TensorDict, seed: int) -> Row:
    """Candidates: what a fit can know of itself."""
    from torchrl_l1.dynamics import read_transitions

    tr = read_transitions(data, seed=seed)
    held = tr.data[tr.validation]
    x, u = held["observation"], held["action"]
    change = held["next", "observation"] - x
    scale = change.std(0, correction=0).clamp_min(1e-9)
    residual = (change - model.mean_change(x, u)) / scale
    h = tr.data["action"].std(0)
    gains = []
    for j in range(u.shape[-1]):
        step = torch.zeros_like(u)
        step[:, j] = h[j]
        gains.append(
            (model.member_changes(x, u + step) - model.member_changes(x, u - step)) / 2 / scale
        )
    per = torch.stack(gains, -1)  # (E, N, n, m) per std of action
    mean = per.mean(0)
    apart = (per - mean).square().sum((-1, -2)).mean().sqrt() / mean.square().sum(
        (-1, -2)
    ).mean().sqrt()
    matched = torch.linalg.lstsq(mean, residual[..., None]).solution[..., 0]

    def mse(actions):
        return ((change - model.mean_change(x, actions)) / scale).square().mean()

    g = torch.Generator().manual_seed(0)
    permuted = mse(u[torch.randperm(len(u), generator=g)])
    explained = model.quality.explained
    return {
        "explained_least": min(explained),
        "explained_mean": float(np.mean(explained)),
        "input_error": float(matched.square().mean().sqrt()),  # in std of the actions
        "input_error_abs": float((matched * h).square().mean().sqrt()),
        "input_std": float(h.mean()),
        "gain_spread": float(apart),
        "action_share": float(1 - mse(u) / permuted),
        "signal": float(
            mean.square().sum((-1, -2)).mean().sqrt() / residual.square().sum(-1).mean().sqrt()
        ),
        "open10": max(e / s for e, s in zip(model.quality.open_loop[10], model.quality.spread)),
    }


def cells():
    for rows in ROWS:
        for excitation in EXCITATIONS:
            for noise in NOISES:
                yield rows, excitation, noise, 2000
    for fit in FITS[:-1]:
        for excitation in EXCITATIONS:
            yield 5000, excitation, 0.0, fit


def main(folder: Path, quick: bool = False) -> None:
    folder.mkdir(exist_ok=True)
    rows: list[Row] = []
    for plant in (inverted_pendulum(), pendulum()):
        clean, off = deployed(plant, 0.0), deployed(plant, plant.bias)
        print(plant.name, clean, off, flush=True)
        configs = {
            "paper": L1Config.paper(plant.dt, epsilon=plant.epsilon),
            "robust": L1Config.robust(plant.dt),
        }
        for (count, excitation, noise, fit), seed in itertools.product(cells(), SEEDS):
            data = record(plant, count, excitation, noise, seed)
            model = fit_dynamics(
                data,
                hidden=(64, 64),
                max_gradient_steps=fit,
                seed=seed,
                batch_size=256,
                max_epochs=1000,
            )
            row: Row = {
                "plant": plant.name,
                "rows": count,
                "excitation": excitation,
                "noise": noise,
                "fit": fit,
                "seed": seed,
            }
            row |= measures(model, data, seed)
            for name, config in configs.items():
                for on, bias in (("", plant.bias), ("_undisturbed", 0.0)):
                    cost = deployed(plant, bias, model, config)
                    row[name + on] = (
                        (off - cost) / (off - clean) if bias else (cost - clean) / (off - clean)
                    )
            rows.append(row)
            print(
                {k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}, flush=True
            )
            write_table(folder / "runs.csv", rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).with_suffix(""))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    main(arguments.folder, arguments.quick)
