"""One call from a task's name to an environment with noise, disturbances and controllers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_l1.envs.mujoco_env import BatchedMujocoEnv
from torchrl_l1.envs.perturbations import DISTURBANCES, ActionNoise, ObservationNoise
from torchrl_l1.envs.task import Task


def _differs(value: float | Sequence[float], neutral: float) -> bool:
    return bool((torch.as_tensor(value, dtype=torch.float64) != neutral).any())


def make_env(
    task: str | Task,
    num_envs: int = 1,
    *,
    action_noise: float = 0.0,
    observation_noise: float = 0.0,
    extra_transforms: Sequence[Transform] = (),
    seed: int | None = None,
    max_steps: int | None = None,
    dtype: torch.dtype = torch.float32,
    threads: int = 1,
    **disturbances: float | Sequence[float],
) -> TransformedEnv:
    r"""Build a benchmark environment with noise, disturbances and further transforms.

    The transforms stand in the order ``[ActuatorGain, ActuatorBias, ActionNoise,
    ObservationNoise, *extra_transforms]``, neutral ones left out. Actions travel from the last to
    the first, observations from the first to the last. A controller among ``extra_transforms``
    therefore sees the noisy observation, and for its output :math:`u` the simulator receives

    .. math:: g \, (u + \xi + b), \qquad \xi \sim U(-w, w),

    with gain :math:`g` and bias :math:`b`: noise and bias enter the actuator, whose effectiveness
    the gain scales. The rollout's ``"action"`` is what the policy wrote.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, or a :class:`~torchrl_l1.envs.Task`.
        num_envs: number of environments.
        action_noise: half-width of :class:`~torchrl_l1.envs.ActionNoise`.
        observation_noise: half-width of :class:`~torchrl_l1.envs.ObservationNoise`.
        extra_transforms: appended in this order, for example an ``L1Transform``.
        seed: seed of the resets; drawn from torch's global generator if ``None``.
        max_steps: steps after which an episode is truncated; the task's horizon if ``None``.
        dtype: floating dtype of observation, action and reward.
        threads: threads that share the physics.
        **disturbances: values of the disturbances of :class:`~torchrl_l1.envs.Perturbation`,
            one number or one for each action entry: ``actuator_bias``, the constant of
            :class:`~torchrl_l1.envs.ActuatorBias`, and ``actuator_gain``, the factor of
            :class:`~torchrl_l1.envs.ActuatorGain`.

    Returns:
        A ``TransformedEnv`` with batch size ``[num_envs]``.

    Raises:
        KeyError: if the task is unknown.
        TypeError: for any other argument.
        ValueError: if a half-width is negative, or a number is not finite.

    Examples:
        >>> env = make_env("inverted_pendulum", 4, action_noise=0.1, actuator_bias=0.5, seed=0)
        >>> [type(transform).__name__ for transform in env.transform]
        ['ActuatorBias', 'ActionNoise']
        >>> env.rollout(10)["next", "reward"].shape
        torch.Size([4, 10, 1])
    """
    known = {entry.setting: entry for entry in DISTURBANCES.values()}
    for setting in disturbances:
        if setting not in known:
            raise TypeError(
                f"make_env has no argument {setting!r}; its disturbances are {', '.join(known)}"
            )
    transforms: list[Transform] = [
        entry.transform(disturbances[setting])
        for setting, entry in reversed(known.items())
        if setting in disturbances and _differs(disturbances[setting], entry.neutral)
    ]
    if action_noise != 0:
        transforms.append(ActionNoise(action_noise))
    if observation_noise != 0:
        transforms.append(ObservationNoise(observation_noise))
    base = BatchedMujocoEnv(
        task, num_envs, seed=seed, max_steps=max_steps, dtype=dtype, threads=threads
    )
    return TransformedEnv(base, Compose(*transforms, *extra_transforms))
