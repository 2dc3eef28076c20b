"""Tasks from elsewhere: what algorithms need to know, read from the environment itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import GymEnv, GymWrapper

from torchrl_l1.checks import check_optional_count
from torchrl_l1.envs.known_rewards import Outcome
from torchrl_l1.envs.mujoco_env import (
    BatchedMujocoEnv,
    CPUEnv,
    declare_specs,
    drawn_seed,
    keep_others,
    reset_rows,
    stepped_rows,
)
from torchrl_l1.envs.plant import Plant, cannot_change, disturbed_model, survives_resets
from torchrl_l1.envs.references import code_digests, making
from torchrl_l1.envs.simulation import LARGEST, turned_bad
from torchrl_l1.envs.single import PAGE, SingleEnv, SingleGymnasiumEnv, SingleTorchRLEnv
from torchrl_l1.envs.sources import EnvironmentSource, environment_source, the_same
from torchrl_l1.envs.task import BadAction, RewardFn, Scalars, Task


class ExternalTask:
    """What algorithms need to know of an environment that is not one of our tasks.

    The counterpart of :class:`Task`: widths, bounds, time step and horizon are read from the
    environment, of which one instance is made for each episode collected in parallel.

    Args:
        source: makes the environment.
        dt: seconds per step, if the environment does not declare it.
        horizon: steps per episode, if the environment does not declare it, or a smaller number.
        observation_keys: parts that make up the observation, in this order, if it has several.

    Attributes:
        name: name of the source.
        observation_dim: width of the observation.
        action_dim: width of the action.
        action_low: lower bound of the actions; a single number if it is the same for all entries.
        action_high: upper bound.
        outcome: reward and termination, if they are known functions of the observation.

    Raises:
        ValueError: for an environment in which no algorithm here can act, or one that lacks
            necessary information, with the setting that supplies it.

    Examples:
        >>> task = ExternalTask(environment_source("gymnasium/Pendulum-v1"))
        >>> task.dt, task.horizon, task.action_low, task.action_high
        (0.05, 200, -2.0, 2.0)
    """

    def __init__(
        self,
        source: EnvironmentSource,
        *,
        dt: float | None = None,
        horizon: int | None = None,
        observation_keys: Sequence[str] = (),
    ) -> None:
        self.source, self.name = source, source.name or "the environment"
        self._keys = tuple(observation_keys)
        check_optional_count("horizon", horizon)
        single = self._single()
        try:
            self.observation_dim = single.observation_dim
            self.action_dim = len(single.low)
            self.action_low, self.action_high = _scalars(single.low), _scalars(single.high)
            self.dt = self._told("dt", "SECONDS", "how long a step takes", dt, single.time_step())
            if dt is not None and abs(dt - self.dt) > 1e-6 * self.dt:
                raise ValueError(
                    f"dt: a step of {self.name} takes {self.dt:g} s, not {dt:g}: leave dt out, or "
                    "correct the environment's own, if that is wrong"
                )
            told = single.horizon()
            self.horizon = horizon or self._told(
                "horizon", "STEPS", "how long an episode is", None, told
            )
            if told is not None and told < self.horizon and not source.gymnasium_id:
                raise ValueError(
                    f"horizon: an episode of {self.name} ends after {told} steps, not "
                    f"{horizon}: leave horizon out, or raise the environment's own limit"
                )
            self.outcome = single.outcome()
            self.has_plant = single.simulation() is not None
        finally:
            single.close()

    def _told(self, key: str, unit: str, what: str, given: Any, told: Any) -> Any:
        if told is None and given is None:
            raise ValueError(f"{self.name} does not declare {what}: give {key}={unit} ({PAGE})")
        return given if told is None else told

    def _single(self, limited: bool = True) -> SingleEnv:
        """A single environment.

        Args:
            limited: whether episodes end at the environment's own horizon.
        """
        if self.source.gymnasium_id:
            options: dict[str, Any] = {} if limited else {"max_episode_steps": -1}
            with making(self.name):
                made = gymnasium.make(self.source.gymnasium_id, disable_env_checker=True, **options)
            return SingleGymnasiumEnv(made, self.name, self._keys)
        env = self.source.build()
        plain = type(env) in (GymEnv, GymWrapper) and getattr(env, "wrapper_frame_skip", 1) == 1
        if plain and isinstance(env._env, gymnasium.Env):
            return SingleGymnasiumEnv(env, self.name, self._keys)
        return SingleTorchRLEnv(env, self.name, self._keys)

    @property
    def imagined_reward(self) -> RewardFn:
        """Reward as a function of the observation, if there is a built-in one.

        Raises:
            ValueError: if there is none.
        """
        return self._known("reward").reward

    @property
    def terminated(self) -> Callable[[Tensor], Tensor]:
        """Termination as a function of the observation, if there is a built-in one.

        Raises:
            ValueError: if there is none.
        """
        return self._known("termination").terminated

    @property
    def terminates(self) -> bool:
        """Whether any state ends an episode."""
        return self._known("termination").terminates

    def _known(self, what: str) -> Outcome:
        if self.outcome is None:
            none = ", none" if what == "termination" else ""
            raise ValueError(
                f"{what}: there is no built-in one for {self.name}; say {what}=learned{none} or "
                f"{what}=MODULE:FUNCTION ({PAGE})"
            )
        return self.outcome

    def sample_starts(self, count: int) -> Tensor:
        """``count`` initial observations ``(count, n)``, seeded by torch's generator."""
        env = self.environment(1)
        starts = [env.reset()["observation"] for _ in range(count)]
        env.close()
        return torch.cat(starts)

    def check_disturbances(self, names: Sequence[str]) -> None:
        """Reject changes of a plant that cannot be accessed.

        Raises:
            ValueError: naming the disturbance.
        """
        for name in names:
            if not (self.has_plant and survives_resets(name)):
                raise ValueError(cannot_change(self.name, name))

    def environment(self, num_envs: int, **settings: Any) -> ExternalEnv:
        """That many environments side by side, see :class:`ExternalEnv`."""
        return ExternalEnv(self, num_envs, **settings)


def _scalars(bound: np.ndarray) -> Scalars:
    entries = tuple(float(value) for value in bound)
    return entries[0] if len(set(entries)) == 1 else entries


class ExternalEnv(CPUEnv):
    """Environments from elsewhere in one process, the counterpart of :class:`BatchedMujocoEnv`.

    Every reset of each environment is seeded from the batch's seed, so what follows does not depend
    on what happened before. Actions are clipped to the bounds, as an actuator would. If an
    observation or reward is not finite, or MuJoCo's simulation has become unstable, that step has
    ``("next", "non_finite")`` and ``("next", "terminated")`` set, its next observation repeats the
    last good one and its reward is zero. Environments that a ``"_step"`` mask leaves out stay as
    they are.

    Args:
        task: the task of the environments.
        num_envs: number of environments; the batch size is ``[num_envs]``.

    Keyword Args:
        seed: seed of the resets; drawn from torch's global generator if ``None``, a different one
            in each worker of :mod:`multiprocessing`.
        max_steps: steps after which an episode is truncated; the task's horizon if ``None``.
        dtype: floating dtype of observation, action and reward.
        threads: accepted, but a single thread steps the environments.
        plant: changes of the plant by name, for Gymnasium's MuJoCo environments; each a number, one
            for each environment, or drawn at resets.

    Raises:
        ValueError: if a count is not positive, or for a plant that cannot be changed like this.

    Examples:
        >>> env = ExternalTask(environment_source("gymnasium/Pendulum-v1")).environment(3, seed=0)
        >>> env.rollout(5)["next", "reward"].shape
        torch.Size([3, 5, 1])
    """

    def __init__(
        self,
        task: ExternalTask,
        num_envs: int = 1,
        *,
        seed: int | None = None,
        max_steps: int | None = None,
        dtype: torch.dtype = torch.float32,
        threads: int = 1,
        plant: Mapping[str, Any] | None = None,
    ) -> None:
        max_steps = task.horizon if max_steps is None else max_steps
        for name, value in {"num_envs": num_envs, "max_steps": max_steps}.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        super().__init__(device="cpu", batch_size=[num_envs])
        self.task, self.num_envs, self.max_steps, self._dtype = task, num_envs, max_steps, dtype
        task.check_disturbances(list(plant or {}))
        self.members = [task._single(limited=False) for _ in range(num_envs)]
        if len({id(member.innermost()) for member in self.members}) < num_envs:
            raise ValueError(the_same(task.name))
        self._models = [member.simulation().model for member in self.members if plant]
        self._plant = Plant(self._models[0], num_envs, plant) if plant else None
        self._change_plant(np.arange(num_envs))
        self._low = np.stack([member.low for member in self.members])
        self._high = np.stack([member.high for member in self.members])
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._observation = np.zeros((num_envs, task.observation_dim), dtype=np.float32)
        low, high = (torch.from_numpy(bound).to(dtype) for bound in (self._low, self._high))
        action_spec = Bounded(low, high, low.shape, dtype=dtype)
        declare_specs(self, task.observation_dim, action_spec, dtype)
        self.set_seed(drawn_seed() if seed is None else seed)

    def _set_seed(self, seed: int | None) -> None:
        self._rng = np.random.default_rng(seed)

    def _change_plant(self, indices: np.ndarray) -> None:
        values = {} if self._plant is None else self._plant.values
        for index in indices if values else ():
            changes = {name: float(each[index]) for name, each in values.items()}
            changed = disturbed_model(self._models[index], changes)
            self.members[index].simulation().model = changed

    def _emitted(self) -> Tensor:
        return torch.from_numpy(self._observation.copy()).to(self._dtype)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        indices = reset_rows(tensordict, self.num_envs)
        if self._plant is not None and self._plant.is_drawn:
            self._plant.redraw(indices)
            self._change_plant(indices)
        for index in indices:
            self._observation[index] = self.members[index].reset(int(self._rng.integers(2**31)))
        self._steps[indices] = 0
        return self._data({}, *(np.zeros(self.num_envs, dtype=bool) for _ in range(3)))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        stepped = stepped_rows(tensordict, self.num_envs)
        actions = tensordict.get("action").detach().float().numpy().clip(self._low, self._high)
        chosen = np.ones(self.num_envs, dtype=bool) if stepped is None else stepped.numpy()
        actions[~chosen] = 0.0
        if not np.isfinite(actions).all():
            raise BadAction("'action' is not finite; check the policy's output")
        reward = np.zeros(self.num_envs, dtype=np.float32)
        bad, terminated, truncated = (np.zeros(self.num_envs, dtype=bool) for _ in range(3))
        for index in np.flatnonzero(chosen):
            stepping = self.members[index].step(actions[index])
            observation, earned, terminated[index], truncated[index] = stepping
            inner = getattr(self.members[index].simulation(), "data", None)
            broke = isinstance(inner, mujoco.MjData) and turned_bad(inner)
            bad[index] = broke or not (np.isfinite(observation).all() and abs(earned) <= LARGEST)
            if not bad[index]:
                self._observation[index], reward[index] = observation, earned
        self._steps += chosen
        truncated |= self._steps >= self.max_steps
        earned_ = {"reward": torch.from_numpy(reward).unsqueeze(-1).to(self._dtype)}
        data = self._data(earned_, bad, terminated | bad, truncated)
        return data if stepped is None else keep_others(data, tensordict, stepped)

    def _data(
        self,
        more: Mapping[str, Tensor],
        bad: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
    ) -> TensorDict:
        flags = {
            "non_finite": bad,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        columns = {name: torch.from_numpy(flag).unsqueeze(-1) for name, flag in flags.items()}
        return TensorDict(
            {"observation": self._emitted(), **columns, **more},
            batch_size=self.batch_size,
            device=self.device,
        )

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close all environments."""
        for member in self.members:
            member.close()
        super().close(raise_if_closed=raise_if_closed)


def external_task(
    name: str,
    dt: float | None = None,
    horizon: int | None = None,
    observation_keys: tuple[str, ...] = (),
    search_path: tuple[str | Path, ...] = (),
) -> Task | ExternalTask:
    """The task of an environment by its name; a :class:`Task` if a function returns one.

    Raises:
        ValueError: for a name that means nothing, or an environment that cannot be used.
    """
    code = code_digests([name], search_path)
    return _read(name, dt, horizon, observation_keys, search_path, Path.cwd(), *code.items())


@cache
def _read(
    name: str,
    dt: float | None,
    horizon: int | None,
    observation_keys: tuple[str, ...],
    search_path: tuple[str | Path, ...],
    *state: object,
) -> Task | ExternalTask:
    """Read once for each state of the folder and the code to which the name leads."""
    source = environment_source(name, search_path)
    if source.task is not None:
        return source.task
    if not source.gymnasium_id and isinstance(env := source.build(), BatchedMujocoEnv):
        if env._simulation.simulator.plant is not None:
            raise ValueError(
                f"{name} returns an environment with another plant than its task's: let it return "
                "the task, and give the changes as disturbances"
            )
        return replace(env.task, horizon=env.max_steps)
    return ExternalTask(source, dt=dt, horizon=horizon, observation_keys=observation_keys)
