"""The tasks' names at Gymnasium, which knows them without loading what they need."""

from __future__ import annotations

from collections.abc import Mapping

EPISODE_STEPS: Mapping[str, int] = {
    "inverted_pendulum": 100,
    "inverted_pendulum_unclamped": 100,
    "swimmer": 1000,
    "hopper": 1000,
    "walker": 1000,
    "half_cheetah": 1000,
    "cartpole": 200,
}
"""Steps of an episode of each task, after which Gymnasium's environments truncate it."""


def gymnasium_id(task: str) -> str:
    """The name under which a task is registered with Gymnasium.

    Examples:
        >>> gymnasium_id("half_cheetah")
        'torchrl_l1/HalfCheetah-v0'
    """
    return f"torchrl_l1/{task.title().replace('_', '')}-v0"


def register_tasks() -> None:
    """Makes all tasks known to ``gymnasium.make``, once."""
    # Here, since Gymnasium takes as long to load as a short command may last.
    import gymnasium

    for task, steps in EPISODE_STEPS.items():
        if gymnasium_id(task) not in gymnasium.registry:
            gymnasium.register(
                gymnasium_id(task),
                entry_point="torchrl_l1.envs.gymnasium_env:MujocoTaskEnv",
                max_episode_steps=steps,
                kwargs={"task": task},
            )
