"""Turns a name into a task, or into an environment with noise, disturbances and controllers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import torch
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

from torchrl_l1.checks import check_optional_count
from torchrl_l1.envs.external import external_task
from torchrl_l1.envs.mujoco_env import BatchedMujocoEnv
from torchrl_l1.envs.perturbations import (
    DISTURBANCES,
    ActionNoise,
    ObservationNoise,
    active_disturbances,
    placed_transforms,
    plant_values,
    warn_of_late,
)
from torchrl_l1.envs.plant import does_nothing
from torchrl_l1.envs.sources import EnvironmentSource
from torchrl_l1.envs.task import AnyTask, Task
from torchrl_l1.envs.tasks import TASKS, built_in_task, is_plain
from torchrl_l1.envs.vectors import simulation_of


def get_task(
    task: str | AnyTask,
    *,
    dt: float | None = None,
    horizon: int | None = None,
    observation_keys: Sequence[str] = (),
    search_path: Sequence[str | Path] = (),
) -> AnyTask:
    """Look up a task by name; a task is returned as it is.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, any other environment's name that
            :func:`~torchrl_l1.envs.environment_source` accepts, or a task of your own.
        dt: seconds per step, if an environment from elsewhere does not declare it.
        horizon: steps per episode, if an environment from elsewhere does not declare it, or fewer.
        observation_keys: parts that make up the observation, if an environment has several.
        search_path: folders for files and modules in the name.

    Returns:
        The task.

    Raises:
        KeyError: if no task has this name; the message lists those that exist.
        ValueError: for an environment that does not exist or cannot be used, or that lacks
            necessary information.

    Examples:
        >>> get_task("half_cheetah").observation_dim
        17
        >>> get_task("gymnasium/Pendulum-v1").horizon
        200
    """
    check_optional_count("horizon", horizon)
    found: AnyTask
    if not isinstance(task, str):
        found = task
    elif task in TASKS or is_plain(task):
        found = built_in_task(task)
    else:
        found = external_task(task, dt, horizon, tuple(observation_keys), tuple(search_path))
    name = found.name
    if isinstance(found, Task):
        if dt is not None and dt != found.dt:
            raise ValueError(f"dt: a step of {name} takes {found.dt:g} s; leave dt out")
        if observation_keys:
            raise ValueError(f"observation_keys: the observation of {name} is one vector")
        return found if horizon in (None, found.horizon) else replace(found, horizon=horizon)
    if found is task and (dt or horizon or observation_keys):
        raise ValueError(
            f"dt, horizon and observation_keys go with a name; give them where {name} is made"
        )
    return found


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
    dt: float | None = None,
    horizon: int | None = None,
    observation_keys: Sequence[str] = (),
    search_path: Sequence[str | Path] = (),
    **disturbances: Any,
) -> TransformedEnv:
    r"""Build a benchmark environment with noise, disturbances and further transforms.

    The transforms are in the order ``[*actuators, ActionNoise, ObservationNoise, *sensors,
    *extra_transforms]``, without neutral ones. Actions pass from the last to the first, and the
    actuators are ordered so that the first of :data:`~torchrl_l1.envs.DISTURBANCES` acts first; so
    are the sensors, although observations pass from the first to the last. Changes of the plant are
    not transforms but part of the simulation.

    A controller among ``extra_transforms`` therefore sees the noisy observation. When it sends
    :math:`u`, the simulator receives, with noise, bias and gain,

    .. math:: g \, (u + \xi + b), \qquad \xi \sim U(-w, w),

    with gain :math:`g` and bias :math:`b`: noise and bias enter the actuator, whose effectiveness
    the gain scales. The rollout's ``"action"`` is what the policy wrote.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, any other name that :func:`get_task` accepts,
            or a task itself.
        num_envs: number of environments.
        action_noise: half-width of :class:`~torchrl_l1.envs.ActionNoise`.
        observation_noise: half-width of :class:`~torchrl_l1.envs.ObservationNoise`.
        extra_transforms: appended in this order, for example an ``L1Transform``.
        seed: seed of the resets; drawn from torch's global generator if ``None``.
        max_steps: steps after which an episode is truncated; the task's horizon if ``None``.
        dtype: floating dtype of observation, action and reward.
        threads: threads that share the physics.
        dt: as for :func:`get_task`.
        horizon: likewise.
        observation_keys: likewise.
        search_path: likewise.
        **disturbances: values of the disturbances of :class:`~torchrl_l1.envs.Perturbation`, by
            setting or by name in :data:`~torchrl_l1.envs.DISTURBANCES`. Each is what its transform
            accepts (a number, one for each entry, one row for each environment) or, for the plant,
            a number or one for each environment; or drawn at resets.

    Returns:
        A ``TransformedEnv`` with batch size ``[num_envs]``.

    Raises:
        KeyError: if the task is unknown.
        TypeError: for an unknown argument, or a disturbance that is given twice.
        ValueError: if a half-width is negative, or a disturbance cannot have its value.

    Examples:
        >>> env = make_env("inverted_pendulum", 4, action_noise=0.1, actuator_bias=0.5, seed=0)
        >>> [type(transform).__name__ for transform in env.transform]
        ['ActuatorBias', 'ActionNoise']
        >>> env.rollout(10)["next", "reward"].shape
        torch.Size([4, 10, 1])
    """
    active = active_disturbances(disturbances)
    transforms, sensors = placed_transforms(active)
    if action_noise != 0:
        transforms.append(ActionNoise(action_noise))
    if observation_noise != 0:
        transforms.append(ObservationNoise(observation_noise))
    transforms += sensors
    found = get_task(
        task,
        dt=dt,
        horizon=horizon,
        observation_keys=observation_keys,
        search_path=search_path,
    )
    warn_of_late(active, max_steps or found.horizon)
    settings: dict[str, Any] = {
        "seed": seed,
        "max_steps": max_steps,
        "dtype": dtype,
        "threads": threads,
        "plant": plant_values(active),
    }
    if isinstance(found, Task):
        base: EnvBase = BatchedMujocoEnv(found, num_envs, **settings)
    else:
        base = found.environment(num_envs, **settings)  # type: ignore[attr-defined]
    return TransformedEnv(base, Compose(*transforms, *extra_transforms))


def episode_steps(source: EnvironmentSource) -> float:
    """Steps after which an episode is truncated; infinite if there is no limit."""
    if source.task is not None:
        return source.task.horizon
    told = gymnasium.spec(source.gymnasium_id).max_episode_steps if source.gymnasium_id else None
    return math.inf if told is None else told


def acting_on(source: EnvironmentSource, horizon: float) -> Callable[[Mapping[str, float]], bool]:
    """Distinguish disturbances that can act on an environment from those that cannot.

    The latter are changes of a plant that cannot be accessed or that lacks what they would change
    (friction where nothing touches), and those that begin after the end of an episode.

    Args:
        source: makes the environment.
        horizon: steps of an episode.

    Returns:
        a function that maps a dictionary of disturbances to whether all of them can act.

    Examples:
        >>> from torchrl_l1.envs import environment_source
        >>> can_act = acting_on(environment_source("inverted_pendulum"), 100)
        >>> can_act({"mass": 2.0}), can_act({"friction": 0.5})
        (True, False)
    """
    if source.task is not None:
        model = source.task.build_model()
    else:
        env = source.build()
        model = getattr(simulation_of(env), "model", None)
        env.close(raise_if_closed=False)

    def can_act(disturbances: Mapping[str, float]) -> bool:
        for name, value in disturbances.items():
            entry = DISTURBANCES[name]
            if not source.takes(entry) or entry.begins(value) >= horizon:
                return False
            if entry.of_plant and model is not None and does_nothing(model, name, value):
                return False
        return True

    return can_act
