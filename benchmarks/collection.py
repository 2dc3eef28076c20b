"""Collection with L1 on against L1 off: what the controller costs per real step."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from torchrl.collectors import Collector
from torchrl.envs import Transform

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.algorithms.policy import GaussianPolicy, make_actor
from torchrl_l1.control import L1Transform
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import get_task, make_env

SETTINGS = (("inverted_pendulum", 25, 1.0), ("half_cheetah", 6, 3.0))
"""Task, number of environments, epsilon."""

THREADS = 1
STEPS = 100


def _batches(name: str, num_envs: int, transforms: list[Transform]) -> Iterator[object]:
    """Endless batches of ``STEPS`` steps of every environment."""
    env = make_env(name, num_envs, extra_transforms=transforms, seed=0)
    task = get_task(name)
    actor = make_actor(GaussianPolicy(task.observation_dim, task.action_dim, [32, 32], 1.0))
    collector = Collector(
        env,
        actor,
        frames_per_batch=STEPS * num_envs,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    return iter(collector)


def run(repetitions: int) -> list[Row]:
    """Measure both tasks.

    Args:
        repetitions: interleaved measurements of each variant; one is a batch of the collector.

    Returns:
        One row per task: real steps per second with L1 ``off``, on and ``eager``, on and
        ``compiled``; ``eager_ratio`` and ``compiled_ratio`` are fractions of the speed without L1.
    """
    rows: list[Row] = []
    for name, num_envs, epsilon in SETTINGS:
        task = get_task(name)
        model = EnsembleDynamics(task.observation_dim, task.action_dim)
        variants: dict[str, list[Transform]] = {
            "off": [],
            "eager": [L1Transform(model, dt=task.dt, epsilon=epsilon, compile=False)],
            "compiled": [L1Transform(model, dt=task.dt, epsilon=epsilon, compile=True)],
        }
        cases: dict[str, Callable[[], object]] = {
            variant: _batches(name, num_envs, transforms).__next__
            for variant, transforms in variants.items()
        }
        seconds = interleave(cases, repetitions)
        frames = STEPS * num_envs
        row: Row = {"task": name, "num_envs": num_envs}
        for variant, values in seconds.items():
            row |= spread(variant, [frames / value for value in values])
        for variant in ("eager", "compiled"):
            row |= ratio(f"{variant}_ratio", seconds["off"], seconds[variant])
        rows.append(row)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "collection",
        "Collection with L1 on and off",
        "Real steps per second of a `Collector`, median (range); the ratios are fractions of the "
        "speed without L1. The model has five members of 2 x 256 ReLU units. Where there is no "
        "compiler, `compiled` runs eagerly.",
        run(repetitions),
        {
            "task": "task",
            "num_envs": "environments",
            "off": "L1 off",
            "eager": "L1 on, eager",
            "compiled": "L1 on, compiled",
            "eager_ratio": "eager / off",
            "compiled_ratio": "compiled / off",
        },
        dict.fromkeys(("off", "eager", "compiled"), ",.0f"),
    )
