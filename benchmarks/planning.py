"""One plan by the cross-entropy method: ours against mbrl-lib's and TorchRL's."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.modules import CEMPlanner

from benchmarks import cheetah
from benchmarks.peers import Peer, peer
from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.dynamics.imagination import EnsembleModelEnv
from torchrl_l1.planning import CEMConfig, Precision, Propagation, TrajectorySampler, plan_cem

CONFIG = CEMConfig(
    horizon=25, candidates=400, elites=40, iterations=5, momentum=0.1, minimum_variance=0.0
)
PARTICLES = 20
THREADS = 2
GRADIENT_STEPS = 300
MATRIX = 2048
"""Width of the square matrices whose product tells what the processor can do."""

PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")

# Name: (propagation, particles, members that a candidate goes through, the peer).
PLANS: dict[str, tuple[Propagation, int, int, str]] = {
    f"{PARTICLES} particles, TSinf": ("tsinf", PARTICLES, PARTICLES, "mbrl-lib"),
    "mean of the members": ("mean", 1, cheetah.MEMBERS, "TorchRL"),
    "one member": ("tsinf", 1, 1, "TorchRL"),
}

COMPILED = f"{PARTICLES} particles, TSinf"
"""The plan that is made by compiled code as well."""


def make_plan(
    model: EnsembleDynamics,
    observation: Tensor,
    precision: Precision,
    propagation: Propagation = "tsinf",
    particles: int = PARTICLES,
    generator: torch.Generator | None = None,
    common_noise: bool = True,
    compile: bool = False,
) -> Tensor:
    """One plan of ours ``(1, H, m)`` from an observation ``(1, n)``, copy of weights included."""
    sampler = TrajectorySampler(
        model,
        cheetah.reward,
        particles=particles,
        propagation=propagation,
        precision=precision,
        common_noise=common_noise,
        compile=compile,
    )
    mean = torch.zeros(1, CONFIG.horizon, model.action_dim)
    evaluate = sampler.evaluator(observation, generator)
    return plan_cem(evaluate, mean, -1.0, 1.0, CONFIG, generator).actions


def torchrl_plan(
    model: EnsembleDynamics, observation: Tensor, propagation: str, config: CEMConfig
) -> Callable[[], Tensor]:
    """TorchRL's planner on the same model as an environment."""
    env = EnsembleModelEnv(
        model,
        cheetah.reward,
        start=lambda count: observation.expand(count, -1),
        action_low=-1.0,
        action_high=1.0,
        propagation=propagation,
    )
    planner = CEMPlanner(env, config.horizon, config.iterations, config.candidates, config.elites)
    start = env.reset(TensorDict({}, batch_size=[]))

    @torch.no_grad()
    def plan() -> Tensor:
        return planner.planning(start)

    return plan


def compiles(plan: Callable[..., Tensor]) -> bool:
    """Whether a plan can be compiled; otherwise why not is printed."""
    try:
        plan(compile=True)
    except RuntimeError as error:
        print(f"without compiled plans: {error}", file=sys.stderr)
        return False
    return True


def start_mbrl(worker: Peer, model: EnsembleDynamics) -> None:
    """Give mbrl-lib the same model and the same settings."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.pt"
        cheetah.save_for_mbrl(model, path)
        worker.call("model", path=str(path))
    worker.call(
        "agent",
        horizon=CONFIG.horizon,
        candidates=CONFIG.candidates,
        elites=CONFIG.elites,
        iterations=CONFIG.iterations,
        particles=PARTICLES,
        column=cheetah.SPEED,
        cost=cheetah.COST,
    )


@torch.no_grad()
def check(worker: Peer, model: EnsembleDynamics, observation: Tensor, candidates: int) -> None:
    """Refuse to time models that do not predict the same.

    Raises:
        AssertionError: if the returns of the same sequences differ by more than their noise.
    """
    generator = torch.Generator().manual_seed(0)
    shape = (1, candidates, CONFIG.horizon, model.action_dim)
    actions = 2 * torch.rand(shape, generator=generator) - 1
    sampler = TrajectorySampler(
        model, cheetah.reward, particles=PARTICLES, precision="float32", common_noise=False
    )
    ours = sampler.evaluator(observation, generator)(actions)[0]
    found = worker.call("returns", observation=observation[0].tolist(), actions=actions[0].tolist())
    difference = torch.as_tensor(found) - ours
    error = difference.std() / candidates**0.5
    assert difference.mean().abs() < 5 * error, (
        f"mbrl-lib's returns differ by {difference.mean():.3g} +- {error:.2g}"
    )


def run(repetitions: int) -> list[Row]:
    """Measure all plans.

    Args:
        repetitions: interleaved measurements of each implementation.

    Returns:
        One row per plan and implementation: ``milliseconds``, ``gflops`` per second and, as a
        share of those of a large product in the same precision, ``peak``; ``speedup``, by which
        factor an implementation of ours is faster than the plan's peer, is missing from the
        others. The last rows are the large products.
    """
    buffer = cheetah.transitions(5000, 500)
    model = cheetah.fitted_model(buffer, GRADIENT_STEPS)
    observation = buffer[:]["observation"][-1:]
    cases: dict[tuple[str, str], Callable[[], object]] = {}
    flops: dict[str, float] = {}
    worker = peer(torch.get_num_threads())
    if worker is not None:
        start_mbrl(worker, model)
        check(worker, model, observation, candidates=CONFIG.candidates)
    for name, (propagation, particles, predictions, rival) in PLANS.items():
        steps = CONFIG.candidates * CONFIG.horizon * CONFIG.iterations
        flops[name] = steps * predictions * cheetah.flops_per_prediction(model)
        for precision in PRECISIONS:
            plan = partial(make_plan, model, observation, precision, propagation, particles)
            cases[name, precision] = plan
            if name == COMPILED and compiles(plan):
                cases[name, f"{precision}, compiled"] = partial(plan, compile=True)
        if rival == "TorchRL":
            kind = "mean" if propagation == "mean" else "random_member"
            cases[name, rival] = torchrl_plan(model, observation, kind, CONFIG)
        elif worker is not None:
            cases[name, rival] = partial(worker.call, "plan", observation=observation[0].tolist())
    rows = compared(cases, flops, {name: plan[-1] for name, plan in PLANS.items()}, repetitions)
    if worker is not None:
        worker.close()
    return rows


def compared(
    cases: dict[tuple[str, str], Callable[[], object]],
    flops: dict[str, float],
    rivals: dict[str, str],
    repetitions: int,
) -> list[Row]:
    """Measure plans, and large products beside them.

    Args:
        cases: by plan and implementation; ours begin with their precision.
        flops: of each plan.
        rivals: what ours is compared with, by plan.
        repetitions: interleaved measurements of each case.

    Returns:
        The rows of :func:`run`.
    """
    product = f"product of two matrices, {MATRIX} x {MATRIX}"
    flops = {**flops, product: 2 * MATRIX**3}
    products = {}
    for precision in PRECISIONS:
        matrix = torch.randn(MATRIX, MATRIX).to(getattr(torch, precision))
        products[product, precision] = partial(torch.matmul, matrix, matrix)
    seconds = interleave({**cases, **products}, repetitions, shortest=0.05, warmup=1)
    rows: list[Row] = []
    for (name, implementation), values in seconds.items():
        row: Row = {"plan": name, "implementation": implementation}
        row |= spread("milliseconds", [1e3 * value for value in values])
        row |= spread("gflops", [1e-9 * flops[name] / value for value in values])
        ours = [precision for precision in PRECISIONS if implementation.startswith(precision)]
        fastest = 1e-9 * flops[product] / median(seconds[product, (*ours, "float32")[0]])
        row["peak"] = 1e-7 * flops[name] / median(values) / fastest
        rival = rivals.get(name, "")
        if ours and (name, rival) in seconds:
            row |= ratio("speedup", seconds[name, rival], values)
        rows.append(row)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "planning",
        "Planning",
        f"One plan by the cross-entropy method, {CONFIG.candidates} candidates x horizon "
        f"{CONFIG.horizon} x {CONFIG.iterations} iterations, median (range): ours with hidden "
        "layers in float32 and in bfloat16, eager or compiled, mbrl-lib 0.2.0's "
        "`TrajectoryOptimizerAgent` and TorchRL's `CEMPlanner`, on the same model: five Gaussian "
        "members of 3 x 200 SiLU units, fitted to random data of HalfCheetah (17 observations, "
        "6 actions). GFLOP/s count the products of the model; the peak is what a large product in "
        "the same precision reaches.",
        run(repetitions),
        {
            "plan": "plan",
            "implementation": "implementation",
            "milliseconds": "milliseconds",
            "gflops": "GFLOP/s",
            "peak": "% of peak",
            "speedup": "times as fast as the peer",
        },
        {"milliseconds": ",.0f", "gflops": ",.0f", "peak": ".0f", "speedup": ".1f"},
    )
