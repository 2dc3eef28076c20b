"""Plans made in bfloat16 are worth as much as those made in float32."""

from __future__ import annotations

from statistics import fmean, stdev

import torch
from torch import Tensor

from benchmarks import cheetah, planning
from benchmarks.tables import Table
from benchmarks.timing import Row
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.planning import Precision, TrajectorySampler

PROBLEMS = 5
"""States to plan from."""

PARTICLES = 4000
"""Trajectories by which a plan is judged, float32."""

THREADS = planning.THREADS


@torch.no_grad()
def judged(model: EnsembleDynamics, observation: Tensor, plans: list[Tensor]) -> list[float]:
    """Expected returns of plans ``(1, H, m)``."""
    sampler = TrajectorySampler(model, cheetah.reward, particles=PARTICLES, precision="float32")
    return sampler.evaluator(observation)(torch.stack(plans, 1))[0].tolist()


def run(repetitions: int) -> list[Row]:
    """Plan in both precisions, and in float32 with other random numbers, and judge the plans.

    Args:
        repetitions: plans from each state.

    Returns:
        One row per state and one for all: mean returns in ``float32`` and ``bfloat16``,
        with noise of its own for each candidate (``own_noise``, float32); the ``difference`` of
        the first two and its standard ``error``, and both for two plans in float32 (``seeds``,
        ``seeds_error``).
    """
    buffer = cheetah.transitions(5000, 500)
    model = cheetah.fitted_model(buffer, planning.GRADIENT_STEPS)
    states = buffer[:]["observation"][:: len(buffer) // PROBLEMS][:PROBLEMS]
    torch.manual_seed(0)
    found: list[list[list[float]]] = []
    for problem, observation in enumerate(states.split(1)):
        plans = []
        for seed in range(problem * repetitions, (problem + 1) * repetitions):
            cases: list[tuple[Precision, int, bool]] = [
                ("float32", seed, True),
                ("bfloat16", seed, True),
                ("float32", 10_000 + seed, True),
                ("float32", seed, False),
            ]
            plans += [
                planning.make_plan(
                    model,
                    observation,
                    precision,
                    generator=torch.Generator().manual_seed(number),
                    common_noise=common,
                )
                for precision, number, common in cases
            ]
        values = judged(model, observation, plans)
        found.append([values[first : first + 4] for first in range(0, len(values), 4)])
    rows = [_row(str(number), values) for number, values in enumerate(found)]
    return [*rows, _row("all", [four for values in found for four in values])]


def _row(state: str, values: list[list[float]]) -> Row:
    changes = [low - full for full, low, _, _ in values]
    seeds = [other - full for full, _, other, _ in values]
    root = len(values) ** 0.5
    return {
        "state": state,
        "plans": len(values),
        "float32": fmean(full for full, _, _, _ in values),
        "bfloat16": fmean(low for _, low, _, _ in values),
        "own_noise": fmean(own for _, _, _, own in values),
        "difference": fmean(changes),
        "error": stdev(changes) / root if len(values) > 1 else float("nan"),
        "seeds": fmean(seeds),
        "seeds_error": stdev(seeds) / root if len(values) > 1 else float("nan"),
    }


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "planning_precision",
        "Plans in bfloat16",
        "Expected returns of the plans that the planner of the table above makes in either "
        f"precision with the same random numbers, judged by {PARTICLES} trajectories in float32, "
        "from states of HalfCheetah under random actions; the difference with its standard "
        "error, and beside it that of two plans in float32 with other random numbers. `own noise` "
        "are plans in float32 whose candidates do not share random numbers.",
        run(repetitions),
        {
            "state": "state",
            "plans": "plans",
            "float32": "float32",
            "bfloat16": "bfloat16",
            "own_noise": "float32, own noise",
            "difference": "difference",
            "error": "standard error",
            "seeds": "difference of two in float32",
            "seeds_error": "standard error of that",
        },
        {},
    )
