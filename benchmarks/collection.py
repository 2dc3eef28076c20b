"""Collection with L1 on against L1 off: what the controller costs per real step."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Transform

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Transform
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, fit_ensemble
from torchrl_l1.envs import Task, get_task, make_env

SETTINGS = (("inverted_pendulum", 25, 1.0), ("half_cheetah", 6, 3.0), ("half_cheetah", 25, 3.0))
"""Task, number of environments, epsilon."""

WIDTHS = (200, 256)
"""Units of each of the model's two hidden layers."""

COMPILE: dict[str, CompileMode] = {"eager": False, "compiled": "auto"}
"""Variants with L1 on."""

THREADS = 2
STEPS = 100
FIT = FitConfig(max_gradient_steps=300)


def fitted_model(task: Task, width: int, fit: FitConfig) -> EnsembleDynamics:
    """A model of random data, as in the first iteration: an unfitted one would not switch."""
    torch.manual_seed(0)
    data = make_env(task, 25, seed=0).rollout(STEPS, break_when_any_done=False).reshape(-1)
    items = data.select("observation", "action", ("next", "observation"))
    items["validation"] = torch.rand(len(items)) < fit.validation_fraction
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(items)), batch_size=fit.batch_size)
    buffer.extend(items)
    model = EnsembleDynamics(task.observation_dim, task.action_dim, hidden=(width, width))
    fit_ensemble(model, buffer, fit, torch.optim.Adam(model.parameters(), lr=fit.learning_rate))
    return model


def _batches(task: Task, num_envs: int, transforms: list[Transform]) -> Iterator[TensorDictBase]:
    """Endless batches of ``STEPS`` steps of every environment, by an untrained policy."""
    torch.manual_seed(0)
    n, m = task.observation_dim, task.action_dim
    collector = Collector(
        make_env(task, num_envs, extra_transforms=transforms, seed=0),
        acting(GaussianPolicy(n, m, [32, 32], 1.0), task),
        frames_per_batch=STEPS * num_envs,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    return iter(collector)


def run(repetitions: int) -> list[Row]:
    """Measure all settings.

    Args:
        repetitions: interleaved measurements of each variant; one is a batch of the collector.

    Returns:
        One row per setting and width: switches per 1000 steps (``switches``), real steps per second
        with L1 ``off``, on and ``eager``, on and ``compiled``; ``eager_ratio`` and
        ``compiled_ratio`` are fractions of the speed without L1.
    """
    rows: list[Row] = []
    models: dict[tuple[str, int], EnsembleDynamics] = {}
    for name, num_envs, epsilon in SETTINGS:
        task = get_task(name)
        for width in WIDTHS:
            if (name, width) not in models:
                models[name, width] = fitted_model(task, width, FIT)
            model = models[name, width]
            variants: dict[str, list[Transform]] = {"off": []} | {
                variant: [L1Transform(model, dt=task.dt, epsilon=epsilon, compile=mode)]
                for variant, mode in COMPILE.items()
            }
            batches = {
                variant: _batches(task, num_envs, transforms)
                for variant, transforms in variants.items()
            }
            switches = next(batches["eager"])["next", "l1", "switch"].float().mean().item()
            cases: dict[str, Callable[[], object]] = {
                variant: iterator.__next__ for variant, iterator in batches.items()
            }
            # Two batches to warm up: torch compiles at the first.
            seconds = interleave(cases, repetitions)
            row: Row = {"task": name, "num_envs": num_envs, "model": f"2 x {width}"}
            row["switches"] = 1000 * switches
            for variant, values in seconds.items():
                row |= spread(variant, [STEPS * num_envs / value for value in values])
            for variant in COMPILE:
                row |= ratio(f"{variant}_ratio", seconds["off"], seconds[variant])
            rows.append(row)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "collection",
        "Collection with L1 on and off",
        "Real steps per second of a `Collector`, median (range); the ratios are fractions of the "
        "speed without L1. Five members of ReLU units, fitted to random data; an untrained policy. "
        "Where there is no working compiler, `compiled` runs eagerly.",
        run(repetitions),
        {
            "task": "task",
            "num_envs": "environments",
            "model": "model",
            "switches": "switches per 1000 steps",
            "off": "L1 off",
            "eager": "L1 on, eager",
            "compiled": "L1 on, compiled",
            "eager_ratio": "eager / off",
            "compiled_ratio": "compiled / off",
        },
        dict.fromkeys(("off", "eager", "compiled", "switches"), ",.0f"),
    )
