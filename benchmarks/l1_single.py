"""What L1 adds to a step of a single environment, all of TorchRL around it included."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, SerialEnv, TransformedEnv

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, spread, undisturbed_clock
from torchrl_l1.control import L1Config, L1State, L1Transform, time_step
from torchrl_l1.control.seal import SEAL, seal_width
from torchrl_l1.dynamics import EnsembleDynamics

TASKS = {
    ("InvertedPendulum-v5", 1): (4, 1),
    ("InvertedPendulum-v5", 25): (4, 1),
    ("HalfCheetah-v5", 1): (17, 6),
}
"""Observations n and actions m of so many of Gymnasium's environments."""

HIDDEN = (256, 256)
THREADS = 1

CASES: Mapping[str, Mapping[str, Any]] = {
    "alone": {},
    "paper": {"config": L1Config.paper},
    "unsealed": {"config": L1Config.paper, "check": False},
    "silent": {"config": L1Config.paper, "diagnostics": False},
    "compiled": {"config": L1Config.paper, "compile": True},
    "robust": {"config": L1Config.robust},
}
"""The environment alone, and with L1: as it is, less seals or diagnostics, compiled; robust."""

PAIRS = 10
"""The share of the seals is small: it is the median of so many times as many short measurements."""


class Unsealed(L1Transform):
    """L1 with seals that are zero, and not looked at."""

    def _seal(
        self, nested: TensorDictBase, observation: Tensor, state: L1State | None = None
    ) -> None:
        layout = self._resolve()
        width = seal_width(
            layout.observation_dim, layout.action_dim, "covariance" in self._state_names
        )
        nested.set(SEAL, observation.new_zeros(()).expand(*nested.shape, width))


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
    for (task, count), (n, m) in TASKS.items():
        torch.manual_seed(0)
        model = EnsembleDynamics(n, m, hidden=HIDDEN).eval()
        steps = {name: _stepper(task, count, model, **CASES[name]) for name in CASES}
        seconds = interleave(steps, repetitions, shortest=0.2, clock=undisturbed_clock())
        row: Row = {"task": task, "num_envs": count}
        row |= spread("alone", [1e6 * value for value in seconds["alone"]])
        for name in list(CASES)[1:]:
            pairs = zip(seconds[name], seconds["alone"], strict=True)
            row |= spread(name, [1e6 * (with_l1 - alone) for with_l1, alone in pairs])
        both = {name: steps[name] for name in ("paper", "unsealed")}
        seconds = interleave(both, PAIRS * repetitions, clock=undisturbed_clock())
        pairs = zip(seconds["paper"], seconds["unsealed"], strict=True)
        row |= spread("seal_share", [1 - without / sealed for sealed, without in pairs])
        rows.append(row)
    return rows


def _stepper(
    task: str,
    count: int,
    model: EnsembleDynamics,
    config: Callable[[float], L1Config] | None = None,
    check: bool = True,
    **options: Any,
) -> Callable[[], None]:
    """One step after the other, by a policy that costs nothing."""
    make = partial(GymEnv, task)
    base: EnvBase = make() if count == 1 else SerialEnv(count, make)
    env = TransformedEnv(base, DoubleToFloat(in_keys=["observation"]))
    if config is not None:
        dt = time_step(make())
        assert dt is not None
        kind = L1Transform if check else Unsealed
        env.append_transform(kind(model, config(dt), check=check, **options))
    env.set_seed(0)
    data, action = env.reset(), torch.zeros(*env.batch_size, model.action_dim)

    def step() -> None:
        nonlocal data
        data.set("action", action)
        _, data = env.step_and_maybe_reset(data)

    return step


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "l1_single",
        "L1 around a single environment",
        "Microseconds of a step with all that TorchRL does around it, median (range): of "
        "Gymnasium's environments alone, and what L1 adds, for five members of 2 x 256 ReLU units: "
        "the paper's controller, the same without seals, without diagnostics and compiled, and the "
        "robust one. Last the share of the seals in a step with L1.",
        run(repetitions),
        {
            "task": "environment",
            "num_envs": "environments",
            "alone": "alone",
            "paper": "paper",
            "unsealed": "without seals",
            "silent": "without diagnostics",
            "compiled": "compiled",
            "robust": "robust",
            "seal_share": "share of the seals",
        },
        {**dict.fromkeys(CASES, ",.0f"), "seal_share": ".1%"},
    )
