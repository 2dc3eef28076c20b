"""Collection with L1 on against L1 off: what the controller costs per real step."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import IndependentNormal, ProbabilisticActor

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.algorithms.collection import Collection
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, fit_ensemble
from torchrl_l1.envs import TASKS, Perturbation, Task, make_env

SETTINGS = (("inverted_pendulum", 25, 1.0), ("half_cheetah", 6, 3.0), ("half_cheetah", 25, 3.0))
"""Task, number of environments, epsilon."""

WIDTHS = (200, 256)
"""Units of each of the model's two hidden layers."""

COMPILE: dict[str, CompileMode] = {"eager": False, "compiled": "auto"}
"""Variants with L1 on."""

THREADS = 2
THREAD_COUNTS = (1, 2)
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


def _policies(task: Task) -> dict[str, TensorDictModuleBase]:
    """An untrained policy behind the actor that collects, and behind TorchRL's own."""
    torch.manual_seed(0)
    policy = GaussianPolicy(task.observation_dim, task.action_dim, [32, 32], 1.0)
    actor = ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=IndependentNormal,
    )
    clip = TensorDictModule(
        lambda action: action.clamp(task.action_low, task.action_high), ["action"], ["action"]
    )
    return {"light": acting(policy, task), "torchrl": TensorDictSequential(actor, clip)}


def _collecting(collection: Collection) -> Callable[[], object]:
    iterations = count()
    return lambda: collection.collect(0, next(iterations))


def run(repetitions: int, threads: tuple[int, ...]) -> list[Row]:
    """Measure all settings.

    Args:
        repetitions: interleaved measurements of each variant; one is ``STEPS`` steps of every
            environment.
        threads: numbers of threads of torch, one after the other.

    Returns:
        One row per number of threads, setting and width: switches per 1000 steps (``switches``),
        real steps per second with L1 ``off``, on and ``eager``, on and ``compiled``, and without
        L1 with TorchRL's own actor (``torchrl``); ``eager_ratio`` and ``compiled_ratio`` are
        fractions of the speed without L1, ``actor_ratio`` is the gain over ``torchrl``.
    """
    rows: list[Row] = []
    models: dict[tuple[str, int], EnsembleDynamics] = {}
    before = torch.get_num_threads()
    for threads_now in threads:
        torch.set_num_threads(threads_now)
        for name, num_envs, epsilon in SETTINGS:
            task = TASKS[name]
            for width in WIDTHS:
                if (name, width) not in models:
                    models[name, width] = fitted_model(task, width, FIT)
                measured = _measure(task, num_envs, epsilon, models[name, width], repetitions)
                row: Row = {"threads": threads_now, "task": name, "num_envs": num_envs}
                rows.append(row | {"model": f"2 x {width}"} | measured)
    torch.set_num_threads(before)
    return rows


def _measure(
    task: Task, num_envs: int, epsilon: float, model: EnsembleDynamics, repetitions: int
) -> Row:
    policies = _policies(task)
    l1 = L1Config(task.dt, epsilon=epsilon)
    arms: dict[str, tuple[str, L1Config | None, CompileMode]] = {"off": ("light", None, False)}
    arms |= {variant: ("light", l1, mode) for variant, mode in COMPILE.items()}
    arms["torchrl"] = ("torchrl", None, False)
    collections = {
        name: Collection(
            task, num_envs, policies[actor], model, config, Perturbation(), STEPS, mode
        )
        for name, (actor, config, mode) in arms.items()
    }
    signals = collections["eager"].collect(0, 0)["next", "l1"]
    # Two batches to warm up: torch compiles at the first.
    seconds = interleave({name: _collecting(arm) for name, arm in collections.items()}, repetitions)
    row: Row = {"switches": 1000 * signals["switch"].float().mean().item()}
    for variant, values in seconds.items():
        row |= spread(variant, [STEPS * num_envs / value for value in values])
    for variant in COMPILE:
        row |= ratio(f"{variant}_ratio", seconds["off"], seconds[variant])
    return row | ratio("actor_ratio", seconds["torchrl"], seconds["off"])


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "collection",
        "Collection with L1 on and off",
        "Real steps per second of a `Collection`, median (range); the ratios of L1 are fractions "
        "of the speed without it, that of the actor is the gain over TorchRL's own actor without "
        "L1. Five members of ReLU units, fitted to random data; an untrained policy. Where there "
        "is no working compiler, `compiled` runs eagerly.",
        run(repetitions, THREAD_COUNTS),
        {
            "threads": "threads",
            "task": "task",
            "num_envs": "environments",
            "model": "model",
            "switches": "switches per 1000 steps",
            "torchrl": "L1 off, TorchRL's actor",
            "off": "L1 off",
            "eager": "L1 on, eager",
            "compiled": "L1 on, compiled",
            "eager_ratio": "eager / off",
            "compiled_ratio": "compiled / off",
            "actor_ratio": "off / TorchRL's actor",
        },
        dict.fromkeys(("torchrl", "off", "eager", "compiled", "switches"), ",.0f"),
    )
