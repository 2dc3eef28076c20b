"""Environment steps per second: one batched environment against TorchRL's ``SerialEnv(GymEnv)``.

Both sides run the same physics on the same number of environments with the same prerecorded random
actions, through ``step_and_maybe_reset`` (what a collector calls). No episode ends on either side
(Gymnasium's own termination of the pendulum is ignored), so that neither pays for resets that the
other does not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
from torch import Tensor
from torchrl.envs import EnvBase, GymWrapper, SerialEnv

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.envs import BatchedMujocoEnv

GYM_IDS = {"inverted_pendulum": "InvertedPendulum-v5", "half_cheetah": "HalfCheetah-v5"}
NUM_ENVS = 25
STEPS = 80
THREADS = 1


class _Endless(gymnasium.Wrapper):
    """Ignores termination and time limit."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, _, _, info = self.env.step(action)
        return observation, reward, False, False, info


def _gym_env(task: str) -> EnvBase:
    return GymWrapper(_Endless(gymnasium.make(GYM_IDS[task])))


def _stepping(env: EnvBase, actions: list[Tensor]) -> Callable[[], None]:
    """Steps through the actions, from where the last call stopped."""
    current = env.reset()

    def advance() -> None:
        nonlocal current
        for action in actions:
            _, current = env.step_and_maybe_reset(current.set("action", action))

    return advance


def run(repetitions: int) -> list[Row]:
    """Measure both tasks.

    Args:
        repetitions: interleaved measurements of each implementation.

    Returns:
        One row per task: steps per second of the ``batched`` environments with one thread and
        (``batched_2``) two, of the ``serial`` ones, which know no threads, and both ratios.
    """
    rows: list[Row] = []
    for task in GYM_IDS:
        envs: dict[str, EnvBase] = {
            "batched": BatchedMujocoEnv(task, NUM_ENVS, seed=0, max_steps=10**9),
            "batched_2": BatchedMujocoEnv(task, NUM_ENVS, seed=0, max_steps=10**9, threads=2),
            "serial": SerialEnv(NUM_ENVS, lambda task=task: _gym_env(task)),
        }
        recorded = [envs["batched"].action_spec.rand() for _ in range(STEPS)]
        cases = {
            name: _stepping(env, [action.to(env.action_spec.dtype) for action in recorded])
            for name, env in envs.items()
        }
        seconds = interleave(cases, repetitions)
        row: Row = {"task": task, "num_envs": NUM_ENVS}
        for name, values in seconds.items():
            row |= spread(name, [STEPS * NUM_ENVS / value for value in values])
        row |= ratio("ratio", seconds["serial"], seconds["batched"])
        row |= ratio("ratio_2", seconds["serial"], seconds["batched_2"])
        rows.append(row)
        for env in envs.values():
            env.close()
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "env_stepping",
        "Environment stepping",
        "Environment steps per second, median (range): the batched environment with one and with "
        "two threads, and `SerialEnv(GymEnv)`, which knows no threads.",
        run(repetitions),
        {
            "task": "task",
            "num_envs": "environments",
            "batched": "batched, 1 thread",
            "batched_2": "batched, 2 threads",
            "serial": "SerialEnv",
            "ratio": "1 thread / SerialEnv",
            "ratio_2": "2 threads / SerialEnv",
        },
        {
            "batched": ",.0f",
            "batched_2": ",.0f",
            "serial": ",.0f",
            "ratio": ".1f",
            "ratio_2": ".1f",
        },
    )
