"""What L1 adds to a step of a single environment, all of TorchRL around it included."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import DoubleToFloat, GymEnv, TransformedEnv

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, spread, undisturbed_clock
from torchrl_l1.control import L1Config, L1State, L1Transform, time_step, transform
from torchrl_l1.control.seal import seal_width
from torchrl_l1.dynamics import EnsembleDynamics

TASKS = {"InvertedPendulum-v5": (4, 1), "HalfCheetah-v5": (17, 6)}
"""Observations n and actions m of Gymnasium's environments."""

HIDDEN = (256, 256)
THREADS = 1

CASES: Mapping[str, Mapping[str, Any]] = {
    "alone": {},
    "paper": {"config": L1Config.paper},
    "unsealed": {"config": L1Config.paper},
    "silent": {"config": L1Config.paper, "diagnostics": False},
    "robust": {"config": L1Config.robust},
}
"""The environment alone, and with L1: as it is, without seals, without diagnostics; robust."""


@torch.no_grad()
def run(repetitions: int) -> list[Row]:
    """Measure all cases.

    Args:
        repetitions: interleaved measurements of each case.

    Returns:
        One row per task: microseconds of a step ``alone``, and how much more the others take;
        ``seal_share`` is that of the seals in a step with L1.
    """
    rows: list[Row] = []
    for task, (n, m) in TASKS.items():
        steps = {name: _stepper(task, n, m, name == "unsealed", **CASES[name]) for name in CASES}
        seconds = interleave(steps, repetitions, shortest=0.2, clock=undisturbed_clock())
        row: Row = {"task": task, **spread("alone", [1e6 * value for value in seconds["alone"]])}
        for name in list(CASES)[1:]:
            pairs = zip(seconds[name], seconds["alone"], strict=True)
            row |= spread(name, [1e6 * (with_l1 - alone) for with_l1, alone in pairs])
        pairs = zip(seconds["paper"], seconds["unsealed"], strict=True)
        row |= spread("seal_share", [1 - without / sealed for sealed, without in pairs])
        rows.append(row)
    return rows


def _stepper(
    task: str,
    n: int,
    m: int,
    unsealed: bool,
    config: Callable[[float], L1Config] | None = None,
    **options: Any,
) -> Callable[[], None]:
    """One step after the other of one environment, by a policy that costs nothing."""
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv(task), DoubleToFloat(in_keys=["observation"]))
    if config is not None:
        model = EnsembleDynamics(n, m, hidden=HIDDEN).eval()
        dt = time_step(GymEnv(task))
        assert dt is not None
        env.append_transform(L1Transform(model, config(dt), check=not unsealed, **options))
    env.set_seed(0)
    data, action = env.reset(), torch.zeros(m)

    def step() -> None:
        nonlocal data
        data.set("action", action)
        _, data = env.step_and_maybe_reset(data)

    def without_seals() -> None:
        with _without_seals():
            step()

    return without_seals if unsealed else step


@contextmanager
def _without_seals() -> Iterator[None]:
    """What :func:`~torchrl_l1.control.seal.sealed` computes is zero meanwhile."""
    own = transform.sealed
    nothing: dict[int, Tensor] = {}

    def constant(observation: Tensor, state: L1State) -> Tensor:
        width = observation.shape[-1]
        if width not in nothing:
            nothing[width] = torch.zeros(seal_width(width))
        return nothing[width]

    transform.sealed = constant
    try:
        yield
    finally:
        transform.sealed = own


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "l1_single",
        "L1 around a single environment",
        "Microseconds of a step with all that TorchRL does around it, median (range): of "
        "Gymnasium's environment alone, and what L1 adds, for five members of 2 x 256 ReLU units: "
        "the paper's controller, the same without seals and without diagnostics, and the robust "
        "one. Last the share of the seals in a step with L1.",
        run(repetitions),
        {
            "task": "environment",
            "alone": "alone",
            "paper": "paper",
            "unsealed": "without seals",
            "silent": "without diagnostics",
            "robust": "robust",
            "seal_share": "share of the seals",
        },
        {**dict.fromkeys(("alone", "paper", "unsealed", "silent", "robust"), ",.0f"),
         "seal_share": ".1%"},
    )  # fmt: skip
