"""Imagined trajectories: all on a frozen copy of the model, against step by step in the model."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from benchmarks import cheetah
from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread, undisturbed_clock
from torchrl_l1.algorithms.policy import GaussianPolicy
from torchrl_l1.dynamics import EnsembleDynamics, imagine
from torchrl_l1.envs import get_task

THREADS = 1
TRAJECTORIES, HORIZON = 250, 200
HIDDEN = (200, 200, 200)


@torch.no_grad()
def step_by_step(
    model: EnsembleDynamics, policy: GaussianPolicy, start: Tensor, horizon: int
) -> tuple[Tensor, Tensor]:
    """Observations ``(T, B, n)`` and rewards ``(T, B)`` through the methods of the model."""
    observation, path, rewards = start, [], []
    for member in torch.randint(model.members, (horizon,)).tolist():
        action = policy.sample(observation).clamp(-1, 1)
        successor = observation + model.member_change(observation, action, member)
        inside = model.box.contains(successor)
        successor = torch.where(inside[:, None], successor, observation)
        path.append(observation)
        rewards.append(cheetah.reward(observation, action, successor))
        observation = successor
    return torch.stack(path), torch.stack(rewards)


def run(repetitions: int) -> list[Row]:
    """Measure each.

    Args:
        repetitions: interleaved measurements of each.

    Returns:
        One row per implementation: ``milliseconds``, and but for the first ``speedup``.
    """
    task = get_task("half_cheetah")
    torch.manual_seed(0)
    n, m = task.observation_dim, task.action_dim
    model = EnsembleDynamics(n, m, cheetah.MEMBERS, HIDDEN, activation="silu")
    model.fit_statistics(
        torch.randn(1000, n), 2 * torch.rand(1000, m) - 1, 0.01 * torch.randn(1000, n)
    )
    policy, bound = GaussianPolicy(n, m, (32, 32), std=0.5), torch.ones(m)
    start = 0.3 * torch.randn(TRAJECTORIES, n)

    def imagined(precision: str) -> object:
        return imagine(
            model,
            policy.sampler(),
            cheetah.reward,
            start,
            HORIZON,
            -bound,
            bound,
            precision=precision,  # type: ignore[arg-type]
        )

    cases: dict[str, Callable[[], object]] = {
        "step by step": partial(step_by_step, model, policy, start, HORIZON),
        "float32": partial(imagined, "float32"),
        "bfloat16": partial(imagined, "bfloat16"),
    }
    seconds = interleave(cases, repetitions, shortest=0.0, clock=undisturbed_clock())
    rows: list[Row] = []
    for implementation, values in seconds.items():
        row: Row = {"implementation": implementation}
        row |= spread("milliseconds", [1e3 * value for value in values])
        if implementation != "step by step":
            row |= ratio("speedup", seconds["step by step"], values)
        rows.append(row)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "imagination",
        "Imagined trajectories",
        f"{TRAJECTORIES} trajectories of {HORIZON} steps of HalfCheetah, median (range), in five "
        f"deterministic members of {len(HIDDEN)} x {HIDDEN[0]} SiLU units: step by step through "
        "the methods of the model, and `imagine` in either precision. Processor time with one "
        "thread, wall-clock time with more.",
        run(repetitions),
        {
            "implementation": "implementation",
            "milliseconds": "milliseconds",
            "speedup": "times as fast as step by step",
        },
        {"milliseconds": ".0f"},
    )
