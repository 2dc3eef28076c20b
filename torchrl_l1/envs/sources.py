"""Environments by name, or by a function that makes them, ready for a policy with L1."""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium
from torchrl.envs import (
    Compose,
    DMControlEnv,
    EnvBase,
    GymEnv,
    GymWrapper,
    SerialEnv,
    Transform,
    TransformedEnv,
)

from torchrl_l1.control import time_step
from torchrl_l1.envs.mujoco_env import BatchedMujocoEnv
from torchrl_l1.envs.perturbations import (
    DISTURBANCES,
    Disturbance,
    active_disturbances,
    placed_transforms,
    plant_values,
)
from torchrl_l1.envs.plant import cannot_change, disturbed_model, survives_resets
from torchrl_l1.envs.references import find_attribute, load_module, making, require
from torchrl_l1.envs.task import Task
from torchrl_l1.envs.tasks import TASKS
from torchrl_l1.envs.vectors import innermost, simulation_of, vector_environment

MakeEnv: TypeAlias = str | Task | Callable[[], EnvBase]
"""A name, one of our tasks, or a function that makes an environment."""

FORMS = (
    "gymnasium/ID (gymnasium/Pendulum-v1), a task of ours "
    f"({', '.join(TASKS)}), PACKAGE:ID, dm_control/DOMAIN/TASK, or MODULE:FUNCTION and "
    "FILE.py:FUNCTION, which return a TorchRL environment"
)
"""The supported kinds of names, in words."""


@dataclass(frozen=True)
class EnvironmentSource:
    """Makes the same environment any number of times.

    Attributes:
        name: name by which :func:`environment_source` finds it again; empty for a function.
        build: makes one environment, as its library provides it.
        task: the task, if it is one of ours.
        gymnasium_id: the id without the package before it, if it is one of Gymnasium's.
        observation_keys: parts that make up the observation, if not all do.
    """

    name: str
    build: Callable[..., EnvBase]
    task: Task | None = None
    gymnasium_id: str = ""
    observation_keys: tuple[str, ...] = ()

    @property
    def renders(self) -> bool:
        """Whether :attr:`build` accepts Gymnasium's ``render_mode``."""
        return bool(self.gymnasium_id)

    def one(self) -> EnvBase:
        """One environment with a vector ``observation`` and a vector ``action``, both float32."""
        return vector_environment(self.build(), self.observation_keys)

    def several(
        self,
        count: int,
        disturbances: Mapping[str, float] | None = None,
        control: Sequence[Transform] = (),
        seed: int | None = None,
    ) -> TransformedEnv:
        """Several environments at once, disturbed, with their controllers.

        Args:
            count: how many; an environment that is already a batch keeps its own number.
            disturbances: by name, see :data:`~torchrl_l1.envs.DISTURBANCES`.
            control: transforms to append at the end, such as an ``L1Transform``.
            seed: seed of the resets.

        Raises:
            ValueError: for a disturbance that cannot act on the environment.
        """
        given = self._checked(disturbances or {})
        if self.task is not None:
            return _simulated(self.task, count, given, control, seed)
        base = self._changed(given)
        if not base.batch_size:
            seen = weakref.ref(innermost(base))

            def another() -> EnvBase:
                made = self._changed(given)
                if innermost(made) is seen():
                    raise ValueError(the_same(self.name))
                return made

            base = SerialEnv(count, another)
        return _perturbed(base, given, control, seed)

    def single(
        self,
        disturbances: Mapping[str, float] | None = None,
        control: Sequence[Transform] = (),
        seed: int | None = None,
        **options: Any,
    ) -> TransformedEnv:
        """As :meth:`several`, for a single one; a task of ours then has a batch of one.

        Args:
            disturbances: see there.
            control: see there.
            seed: see there.
            **options: options for making it, such as ``render_mode`` if it :attr:`renders`.
        """
        given = self._checked(disturbances or {})
        if self.task is not None:
            return _simulated(self.task, 1, given, control, seed)
        return _perturbed(self._changed(given, **options), given, control, seed)

    def _checked(self, disturbances: Mapping[str, float]) -> dict[str, Any]:
        for name in disturbances:
            if not self.takes(DISTURBANCES[name]):
                raise ValueError(cannot_change(self.name or "a function", name))
        return dict(disturbances)

    def _changed(self, disturbances: Mapping[str, float], **options: Any) -> EnvBase:
        env = vector_environment(self.build(**options), self.observation_keys)
        if plant := plant_values(active_disturbances(disturbances)):
            simulation = simulation_of(env)
            simulation.model = disturbed_model(simulation.model, plant)
        return env

    def takes(self, disturbance: Disturbance) -> bool:
        """Whether a disturbance can act on the environment."""
        if not disturbance.of_plant or self.task is not None:
            return True
        return survives_resets(disturbance.name) and simulation_of(self.build()) is not None

    def time_step(self) -> float | None:
        """Time of one environment step in seconds, if the environment declares it."""
        return self.task.dt if self.task is not None else time_step(self.build())


def the_same(name: str) -> str:
    """The error that a function returns what it returned before, with the remedy."""
    return f"{name or 'the function'} returns the same environment twice: let it make a new one"


def _simulated(
    task: Task,
    count: int,
    disturbances: Mapping[str, float],
    control: Sequence[Transform],
    seed: int | None,
) -> TransformedEnv:
    plant = plant_values(active_disturbances(disturbances))
    base = BatchedMujocoEnv(task, count, seed=seed, plant=plant)
    return _perturbed(base, disturbances, control, None)


def _perturbed(
    base: EnvBase,
    disturbances: Mapping[str, float],
    control: Sequence[Transform],
    seed: int | None,
) -> TransformedEnv:
    actuators, sensors = placed_transforms(active_disturbances(disturbances))
    env = TransformedEnv(base, Compose(*actuators, *sensors, *control), auto_unwrap=True)
    if seed is not None:
        env.set_seed(seed % 2**31)
    return env


def environment_source(env: MakeEnv, search_path: Sequence[str | Path] = ()) -> EnvironmentSource:
    """The source of an environment, from its name or a function.

    Args:
        env: ``gymnasium/ID``; one of our tasks; ``PACKAGE:ID`` of a package that registers with
            Gymnasium; ``dm_control/DOMAIN/TASK``; ``MODULE:FUNCTION`` or ``FILE.py:FUNCTION`` of a
            function without arguments that returns an environment of TorchRL or Gymnasium, or a
            :class:`Task`; or such a function itself.
        search_path: folders for files, and for modules that are not on Python's own path; the
            working directory comes after them.

    Raises:
        TypeError: for an environment instead of a function that makes it.
        ValueError: for a name that means nothing.

    Examples:
        >>> environment_source("gymnasium/Pendulum-v1").time_step()
        0.05
        >>> environment_source("half_cheetah").time_step()
        0.05
    """
    if isinstance(env, EnvBase):
        raise TypeError(
            f"got a {type(env).__name__}: give a function that makes it, such as "
            "lambda: GymEnv('Pendulum-v1'), since several are needed"
        )
    if isinstance(env, Task):
        return _of_task(env.name, env)
    if not isinstance(env, str):
        return EnvironmentSource("", partial(_made, env))
    if env in TASKS:
        return _of_task(env, TASKS[env])
    first, _, rest = env.partition("/")
    if first == "gymnasium" and rest:
        return _of_gymnasium(env, rest, search_path)
    if first == "dm_control":
        return _of_dm_control(env, rest)
    module, _, name = env.rpartition(":")
    if module and name.isidentifier() and (found := find_attribute(env, search_path)) is not None:
        return _of_function(env, found)
    if module.endswith(".py"):
        raise ValueError(f"{module} has no {name!r}; names are {FORMS}")
    if module or env in gymnasium.registry:
        return _of_gymnasium(env, env, search_path)
    raise ValueError(f"unknown environment {env!r}; names are {FORMS}")


def _of_task(name: str, task: Task) -> EnvironmentSource:
    return EnvironmentSource(name, partial(BatchedMujocoEnv, task, 1), task)


def _of_function(name: str, found: Any) -> EnvironmentSource:
    if isinstance(found, Task):
        return _of_task(name, found)
    if not callable(found):
        raise ValueError(f"{name} is a {type(found).__name__}; it must be a function or a Task")
    return EnvironmentSource(name, partial(_made, found, name))


def _made(function: Callable[[], Any], name: str = "the function") -> EnvBase:
    """The result of a function, as an environment of TorchRL."""
    try:
        inspect.signature(function).bind()
    except ValueError:  # functions in C need not declare their arguments
        pass
    except TypeError as error:
        raise ValueError(
            f"{name} cannot be called without arguments ({error}): give a function that can, which "
            "passes them on"
        ) from None
    made = function()
    if isinstance(made, gymnasium.Env):
        try:
            return GymWrapper(made)
        except RuntimeError as error:  # spaces may be mixtures
            raise ValueError(
                f"{name} returns a {type(made).__name__}, which TorchRL cannot wrap ({error}): its "
                f"actions are {made.action_space}, its observations {made.observation_space}"
            ) from error
    if isinstance(made, Task):
        return BatchedMujocoEnv(made, 1)
    if not isinstance(made, EnvBase):
        raise ValueError(
            f"{name} returns a {type(made).__name__}; it must return an environment of TorchRL or "
            "Gymnasium, or a Task"
        )
    return made


def _of_gymnasium(
    name: str, gymnasium_id: str, search_path: Sequence[str | Path]
) -> EnvironmentSource:
    package, colon, rest = gymnasium_id.partition(":")
    try:
        if colon:  # of a package that registers it
            load_module(package, search_path)
        plain = rest if colon else gymnasium_id
        gymnasium.spec(plain)
    except (gymnasium.error.Error, ValueError) as error:
        raise ValueError(f"{name}: {error}; names are {FORMS}") from None
    return EnvironmentSource(name, partial(_gym_env, name, plain), gymnasium_id=plain)


def _gym_env(name: str, plain: str, **options: Any) -> EnvBase:
    with making(name):
        return GymEnv(plain, **options)


def _of_dm_control(name: str, rest: str) -> EnvironmentSource:
    domain, _, task = rest.partition("/")
    if not task:
        raise ValueError(
            f"{name}: write dm_control/DOMAIN/TASK, such as dm_control/cartpole/balance"
        )
    require("dm_control", "dm_control")
    return EnvironmentSource(name, partial(DMControlEnv, domain, task))
