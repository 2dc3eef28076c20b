"""One call from a task's name to an environment with noise, disturbances and controllers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

from torchrl_l1.envs.mujoco_env import BatchedMujocoEnv
from torchrl_l1.envs.perturbations import (
    DISTURBANCES,
    ActionNoise,
    Disturbance,
    ObservationNoise,
)
from torchrl_l1.envs.task import AnyTask, Task
from torchrl_l1.envs.tasks import get_task


def _differs(value: Any, neutral: float) -> bool:
    return callable(value) or bool((torch.as_tensor(value, dtype=torch.float64) != neutral).any())


def _active(given: dict[str, Any]) -> list[tuple[Disturbance, Any]]:
    """The disturbances that do something, with their values, in the order of the registry."""
    known = {entry.setting: entry for entry in DISTURBANCES.values()}
    values: dict[str, Any] = {}
    for argument, value in given.items():
        setting = DISTURBANCES[argument].setting if argument in DISTURBANCES else argument
        if setting not in known:
            raise TypeError(
                f"make_env has no argument {argument!r}; its disturbances are {', '.join(known)}"
            )
        if setting in values:
            raise TypeError(f"make_env got {setting!r} twice, by its setting and by its name")
        values[setting] = value
    return [
        (entry, values[setting])
        for setting, entry in known.items()
        if setting in values and _differs(values[setting], entry.neutral)
    ]


def disturbance_transforms(**disturbances: Any) -> list[Transform]:
    """The transforms of disturbances, in the order in which :func:`make_env` has them.

    They go on any TorchRL environment that has ``action`` and ``observation``, before whatever
    controls it.

    Args:
        **disturbances: as of :func:`make_env`; neutral ones are left out.

    Raises:
        TypeError: for a disturbance that there is not, or that is given twice.
        ValueError: for a change of the plant, which no transform can make, or a value that a
            disturbance cannot have.

    Examples:
        >>> [type(transform).__name__ for transform in disturbance_transforms(gain=0.5, bias=0.3)]
        ['ActuatorGain', 'ActuatorBias']
    """
    active = _active(disturbances)
    plant = [entry.name for entry, _ in active if entry.transform is None]
    if plant:
        raise ValueError(f"{', '.join(plant)}: a change of the plant is no transform, see make_env")
    actuators, sensors = _placed(active)
    return [*actuators, *sensors]


def _placed(active: list[tuple[Disturbance, Any]]) -> tuple[list[Transform], list[Transform]]:
    """Transforms of actions and of observations, each such that the registry's first acts first."""
    placed: dict[str, list[Transform]] = {"action": [], "observation": []}
    for entry, value in active:
        if entry.transform is not None:
            placed[entry.acts_on].append(entry.transform(value))
    return placed["action"][::-1], placed["observation"]


def make_env(
    task: str | AnyTask,
    num_envs: int = 1,
    *,
    action_noise: float = 0.0,
    observation_noise: float = 0.0,
    extra_transforms: Sequence[Transform] = (),
    seed: int | None = None,
    max_steps: int | None = None,
    dtype: torch.dtype = torch.float32,
    threads: int = 1,
    **disturbances: Any,
) -> TransformedEnv:
    r"""Build a benchmark environment with noise, disturbances and further transforms.

    The transforms stand in the order ``[*actuators, ActionNoise, ObservationNoise, *sensors,
    *extra_transforms]``, neutral ones left out. Actions travel from the last to the first, and
    actuators stand such that the first of :data:`~torchrl_l1.envs.DISTURBANCES` acts first; so
    do sensors, as observations travel from the first to the last. Changes of the plant are none
    of transforms but of the simulation.

    A controller among ``extra_transforms`` therefore sees the noisy observation, and for its
    output :math:`u` the simulator receives with noise, bias and gain

    .. math:: g \, (u + \xi + b), \qquad \xi \sim U(-w, w),

    with gain :math:`g` and bias :math:`b`: noise and bias enter the actuator, whose effectiveness
    the gain scales. The rollout's ``"action"`` is what the policy wrote.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, any other name that :func:`get_task` takes,
            or a task itself.
        num_envs: number of environments.
        action_noise: half-width of :class:`~torchrl_l1.envs.ActionNoise`.
        observation_noise: half-width of :class:`~torchrl_l1.envs.ObservationNoise`.
        extra_transforms: appended in this order, for example an ``L1Transform``.
        seed: seed of the resets; drawn from torch's global generator if ``None``.
        max_steps: steps after which an episode is truncated; the task's horizon if ``None``.
        dtype: floating dtype of observation, action and reward.
        threads: threads that share the physics.
        **disturbances: values of the disturbances of :class:`~torchrl_l1.envs.Perturbation`, by
            their settings or by their names in :data:`~torchrl_l1.envs.DISTURBANCES`. Each is
            what its transform takes (a number, one for each entry, one row for each environment)
            or, of the plant, a number or one for each environment; or drawn at resets.

    Returns:
        A ``TransformedEnv`` with batch size ``[num_envs]``.

    Raises:
        KeyError: if the task is unknown.
        TypeError: for any other argument, or a disturbance that is given twice.
        ValueError: if a half-width is negative, or a disturbance cannot have its value.

    Examples:
        >>> env = make_env("inverted_pendulum", 4, action_noise=0.1, actuator_bias=0.5, seed=0)
        >>> [type(transform).__name__ for transform in env.transform]
        ['ActuatorBias', 'ActionNoise']
        >>> env.rollout(10)["next", "reward"].shape
        torch.Size([4, 10, 1])
    """
    active = _active(disturbances)
    transforms, sensors = _placed(active)
    if action_noise != 0:
        transforms.append(ActionNoise(action_noise))
    if observation_noise != 0:
        transforms.append(ObservationNoise(observation_noise))
    transforms += sensors
    found = get_task(task)
    settings: dict[str, Any] = {
        "seed": seed,
        "max_steps": max_steps,
        "dtype": dtype,
        "threads": threads,
        "plant": {entry.name: value for entry, value in active if entry.transform is None},
    }
    if isinstance(found, Task):
        base: EnvBase = BatchedMujocoEnv(found, num_envs, **settings)
    else:
        base = found.environment(num_envs, **settings)  # type: ignore[attr-defined]
    return TransformedEnv(base, Compose(*transforms, *extra_transforms))
