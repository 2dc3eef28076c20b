"""One plan by random shooting: ours against TorchRL's planner with a single iteration."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from benchmarks import cheetah, planning
from benchmarks.tables import Table
from benchmarks.timing import Row
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.planning import (
    CEMConfig,
    Precision,
    Propagation,
    ShootingConfig,
    TrajectorySampler,
    plan_shooting,
)

CONFIG = ShootingConfig(horizon=20, candidates=5000, warm_start=False)
SINGLE = CEMConfig(CONFIG.horizon, CONFIG.candidates, elites=1, iterations=1)
"""What TorchRL's planner is asked for."""

HIDDEN = (500, 500)
THREADS = planning.THREADS
GRADIENT_STEPS = 300

# Name: (members, propagation, what TorchRL's model environment calls the same).
PLANS: dict[str, tuple[int, Propagation, str]] = {
    "one member": (1, "tsinf", "random_member"),
    "mean of 5 members": (5, "mean", "mean"),
}


def make_plan(
    model: EnsembleDynamics,
    observation: Tensor,
    precision: Precision,
    propagation: Propagation,
) -> Tensor:
    """One plan of ours ``(1, H, m)`` from an observation ``(1, n)``, copy of weights included."""
    sampler = TrajectorySampler(
        model, cheetah.reward, particles=1, propagation=propagation, precision=precision
    )
    mean = torch.zeros(1, CONFIG.horizon, model.action_dim)
    return plan_shooting(sampler.evaluator(observation), mean, -1.0, 1.0, CONFIG).actions


def run(repetitions: int) -> list[Row]:
    """Measure all plans.

    Args:
        repetitions: interleaved measurements of each implementation.

    Returns:
        Rows as of :func:`benchmarks.planning.run`.
    """
    buffer = cheetah.transitions(5000, 500)
    observation = buffer[:]["observation"][-1:]
    cases: dict[tuple[str, str], Callable[[], object]] = {}
    flops: dict[str, float] = {}
    for name, (members, propagation, kind) in PLANS.items():
        model = cheetah.fitted_model(
            buffer, GRADIENT_STEPS, cheetah.new_point_model(members, HIDDEN)
        )
        steps = CONFIG.candidates * CONFIG.horizon * members
        flops[name] = steps * cheetah.flops_per_prediction(model)
        for precision in planning.PRECISIONS:
            cases[name, precision] = partial(make_plan, model, observation, precision, propagation)
        cases[name, "TorchRL"] = planning.torchrl_plan(model, observation, kind, SINGLE)
    with warnings.catch_warnings():
        # TorchRL's planner takes the standard deviation of its one elite, and makes no use of it.
        warnings.filterwarnings("ignore", r"std\(\): degrees of freedom", UserWarning)
        return planning.compared(cases, flops, dict.fromkeys(PLANS, "TorchRL"), repetitions)


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "shooting",
        "Random shooting",
        f"One plan by random shooting, {CONFIG.candidates} candidates x horizon {CONFIG.horizon}, "
        "median (range): ours with hidden layers in float32 and in bfloat16, and TorchRL's "
        "`CEMPlanner` with one iteration and one elite, on the same deterministic model of "
        f"{len(HIDDEN)} x {HIDDEN[0]} ReLU units, fitted to random data of HalfCheetah (17 "
        "observations, 6 actions). GFLOP/s count the products of the model; the peak is what a "
        "large product in the same precision reaches.",
        run(repetitions),
        {
            "plan": "plan",
            "implementation": "implementation",
            "milliseconds": "milliseconds",
            "gflops": "GFLOP/s",
            "peak": "% of peak",
            "speedup": "times as fast as TorchRL",
        },
        {"milliseconds": ",.0f", "gflops": ",.0f", "peak": ".0f", "speedup": ".1f"},
    )
