"""Environment steps per second: one batched environment against TorchRL's ``SerialEnv(GymEnv)``.

Both sides run the same physics on the same number of environments with the same kind of
prerecorded random actions, through ``step_and_maybe_reset`` (what a collector calls), in turns
within one process. No episode ends on either side (Gymnasium's own termination of the pendulum
is ignored), so that neither pays for resets that the other does not.

Run as ``python benchmarks/env_stepping.py [--repetitions 7]``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import gymnasium
import torch
from torchrl.envs import EnvBase, GymWrapper, SerialEnv

from torchrl_l1.envs import BatchedMujocoEnv

GYM_IDS = {"inverted_pendulum": "InvertedPendulum-v5", "half_cheetah": "HalfCheetah-v5"}
NUM_ENVS = 25
STEPS = 80


class _Endless(gymnasium.Wrapper):
    """Ignores termination and time limit."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, _, _, info = self.env.step(action)
        return observation, reward, False, False, info


def _gym_env(task: str) -> EnvBase:
    return GymWrapper(_Endless(gymnasium.make(GYM_IDS[task])))


def _steps_per_second(env: EnvBase) -> float:
    current = env.reset()
    actions = [env.action_spec.rand() for _ in range(STEPS)]
    start = time.perf_counter()
    for action in actions:
        _, current = env.step_and_maybe_reset(current.set("action", action))
    return STEPS * NUM_ENVS / (time.perf_counter() - start)


def run(repetitions: int) -> list[dict[str, Any]]:
    """Measures both tasks.

    Args:
        repetitions: interleaved measurements of each implementation.

    Returns:
        One row for each task: ``task``, ``num_envs``, and for ``batched`` and ``serial`` the
        median, lowest and highest steps per second; ``ratio`` is the median of the ratios of
        neighbouring measurements, ``ratio_low`` and ``ratio_high`` their range.
    """
    rows = []
    for task in GYM_IDS:
        envs: dict[str, EnvBase] = {
            "batched": BatchedMujocoEnv(task, NUM_ENVS, seed=0, max_steps=10**9),
            "serial": SerialEnv(NUM_ENVS, lambda task=task: _gym_env(task)),
        }
        found: dict[str, list[float]] = {name: [] for name in envs}
        for repetition in range(repetitions + 1):
            for name, env in envs.items():
                speed = _steps_per_second(env)
                if repetition:  # the first one warms up
                    found[name].append(speed)
        ratios = [a / b for a, b in zip(found["batched"], found["serial"], strict=True)]
        row: dict[str, Any] = {"task": task, "num_envs": NUM_ENVS}
        for name, values in found.items():
            row[name] = statistics.median(values)
            row[f"{name}_low"], row[f"{name}_high"] = min(values), max(values)
        row["ratio"] = statistics.median(ratios)
        row["ratio_low"], row["ratio_high"] = min(ratios), max(ratios)
        rows.append(row)
        for env in envs.values():
            env.close()
    return rows


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=7)
    torch.set_num_threads(1)
    rows = run(parser.parse_args().repetitions)
    print(f"env-steps/s at {NUM_ENVS} environments: median (range)\n")
    print("| task | batched | SerialEnv(GymEnv) | ratio |\n|---|---|---|---|")
    for row in rows:
        cells = [
            f"{row[name]:,.0f} ({row[f'{name}_low']:,.0f} to {row[f'{name}_high']:,.0f})"
            for name in ("batched", "serial")
        ]
        ratio = f"{row['ratio']:.1f} ({row['ratio_low']:.1f} to {row['ratio_high']:.1f})"
        print(f"| {row['task']} | {' | '.join(cells)} | {ratio} |")


if __name__ == "__main__":
    main()
