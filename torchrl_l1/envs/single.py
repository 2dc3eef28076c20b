"""Single environments from elsewhere, whatever their library, with NumPy inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Any, Protocol, TypeGuard

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from gymnasium.utils import EzPickle
from tensordict import TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import EnvBase, FrameSkipTransform, GymWrapper, StepCounter, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.utils import step_mdp

from torchrl_l1.checks import LARGEST_BOUND
from torchrl_l1.control import repeats, time_step
from torchrl_l1.envs.known_rewards import Outcome, known_outcome
from torchrl_l1.envs.vectors import (
    check_keys,
    innermost,
    parts_left_out,
    simulation_of,
    unclear,
    vector_environment,
    vectors,
    wrapped,
)

PAGE = "see the page on environments"
"""Where the kinds of environments are explained."""


class SingleEnv(Protocol):
    """One environment, each reset of which has its own seed.

    Attributes:
        low: lower bounds of the action ``(m,)``.
        high: upper bounds of the action.
        observation_dim: width of the observation.
    """

    low: np.ndarray
    high: np.ndarray
    observation_dim: int

    def reset(self, seed: int) -> np.ndarray:
        """Start an episode; the observation ``(n,)``, float32."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """Observation ``(n,)``, reward, and whether the episode was terminated or truncated."""

    def time_step(self) -> float | None:
        """Seconds per step, if the environment declares it."""

    def horizon(self) -> int | None:
        """Steps per episode, if the environment declares it."""

    def simulation(self) -> Any:
        """The object with MuJoCo's ``model`` and ``data``, if the environment is Gymnasium's."""

    def innermost(self) -> Any:
        """The environment without wrappers."""

    def outcome(self) -> Outcome | None:
        """Reward and termination as functions of the observation, if they are known."""

    def close(self) -> None:
        """Close the environment."""


class _Single:
    """Code common to both; deep copies continue from the original's state, with its plant."""

    env: Any

    def simulation(self) -> Any:
        """See :class:`SingleEnv`."""
        return simulation_of(self.env)

    def innermost(self) -> Any:
        """See :class:`SingleEnv`."""
        return innermost(self.env)

    def __deepcopy__(self, memo: dict[int, Any]) -> _Single:
        try:
            for layer in self._made_anew():
                _copied(layer, memo)
            copied: _Single = _copied(self, memo)
        except TypeError as error:
            raise TypeError(self._cannot_be("copied", str(error))) from error
        return copied

    def __getstate__(self) -> dict[str, Any]:
        if self._made_anew():
            raise TypeError(self._cannot_be("pickled", "gymnasium.utils.EzPickle recreates it"))
        return self.__dict__

    def _made_anew(self) -> list[Any]:
        """Environment and wrappers whose state ordinary copies would lose, innermost first."""
        layer = wrapped(self.env)
        found: list[Any] = []
        while isinstance(layer, gymnasium.Env):
            if getattr(type(layer), "__getstate__", None) is EzPickle.__getstate__:
                found.insert(0, layer)
            layer = layer.env if isinstance(layer, gymnasium.Wrapper) else None
        return found

    def _cannot_be(self, done: str, why: str) -> str:
        name = type(self.innermost()).__name__
        return f"{name} cannot be {done} with its state ({why}): make another one"


class SingleGymnasiumEnv(_Single):
    """An environment of Gymnasium, without TorchRL in between."""

    def __init__(
        self, env: gymnasium.Env[Any, Any] | GymWrapper, name: str, keys: Sequence[str]
    ) -> None:
        # Releasing a wrapper closes the environment inside.
        self._owner, self._name, self._keys = env, name, tuple(keys)
        self.env: gymnasium.Env[Any, Any] = env._env if isinstance(env, GymWrapper) else env
        space = self.env.action_space
        if not isinstance(space, Box) or not np.issubdtype(space.dtype, np.floating):
            raise ValueError(_no_actions(name, space))
        if len(space.shape) != 1:
            raise ValueError(_no_actions(name, f"an array of the shape {space.shape}"))
        self._space = space
        self.low, self.high = _checked_bounds(name, space.low, space.high)
        self.observation_dim = self._read_observation_space()

    def _read_observation_space(self) -> int:
        space, name = self.env.observation_space, self._name
        if not isinstance(space, Dict):
            check_keys(self._keys, (), name)
            if not _is_vector(space) or not space.shape:
                images = isinstance(space, Box) and len(space.shape) > 1
                raise ValueError(
                    f"{name} has {'images or tables' if images else space} as observations; a "
                    "vector of floating-point numbers is needed, which "
                    "gymnasium.wrappers.FlattenObservation makes from tables and "
                    f"DtypeObservation from whole numbers ({PAGE})"
                )
            return int(space.shape[0])
        parts = {key: part for key, part in space.spaces.items() if _is_vector(part)}
        check_keys(self._keys, parts, name)
        left_out = [key for key in space.spaces if key not in parts]
        self._keys = self._keys or _whole(name, list(parts), left_out)
        return sum(int(np.prod(parts[key].shape)) for key in self._keys)

    def _observed(self, observation: Any) -> np.ndarray:
        if self._keys:
            observation = np.concatenate([np.ravel(observation[key]) for key in self._keys])
        found = np.asarray(observation, dtype=np.float32)
        if found.size != self.observation_dim:
            raise ValueError(
                f"{self._name} returned an observation of shape {found.shape}, and its "
                f"observation space has {self.observation_dim} entries"
            )
        return found.reshape(-1)

    def reset(self, seed: int) -> np.ndarray:
        """See :class:`SingleEnv`."""
        return self._observed(self._parts("reset", self.env.reset(seed=seed), 2)[0])

    def _parts(self, method: str, returned: Any, count: int) -> tuple[Any, ...]:
        """The result of a method, which has another form in Gym's old interface."""
        if not isinstance(returned, tuple) or len(returned) != count:
            form = {2: "observation, info", 5: "observation, reward, terminated, truncated, info"}
            raise ValueError(
                f"{self._name}: {method} does not return ({form[count]}), as Gymnasium has it"
            )
        return returned

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """See :class:`SingleEnv`."""
        space = self._space
        # Rounded to single precision, a bound may lie beyond itself.
        within = np.clip(action.astype(space.dtype), space.low, space.high)
        stepped = self._parts("step", self.env.step(within), 5)
        observation, reward, terminated, truncated, _ = stepped
        earned = _number(self._name, reward)
        return self._observed(observation), earned, bool(terminated), bool(truncated)

    def time_step(self) -> float | None:
        """See :class:`SingleEnv`."""
        return time_step(self.env)

    def horizon(self) -> int | None:
        """See :class:`SingleEnv`."""
        return _time_limit(self.env)

    def outcome(self) -> Outcome | None:
        """See :class:`SingleEnv`."""
        return None if self._keys else known_outcome(self.env)

    def close(self) -> None:
        """See :class:`SingleEnv`."""
        self._owner.close()


class SingleTorchRLEnv(_Single):
    """An environment of TorchRL."""

    def __init__(self, env: EnvBase, name: str, keys: Sequence[str]) -> None:
        if tuple(env.batch_size) not in ((), (1,)):
            raise ValueError(
                f"{name} is a batch of {tuple(env.batch_size)} environments; let it return a "
                "single one, which is created as often as needed"
            )
        self._name = name
        parts = vectors(env)
        if not keys and "observation" in parts:
            left_out = parts_left_out(env, parts)
            is_whole = len(parts) == 1 and not left_out
            keys = ("observation",) if is_whole else _whole(name, list(parts), left_out)
        try:
            self.env = vector_environment(env, keys)
        except ValueError as error:
            raise ValueError(f"{name}: {error} ({PAGE})") from None
        spec = self.env.action_spec
        if not isinstance(spec, Bounded):
            raise ValueError(_unbounded(name, "no bounds"))
        low, high = (np.ravel(bound.numpy()) for bound in (spec.space.low, spec.space.high))
        self.low, self.high = _checked_bounds(name, low, high)
        self.observation_dim = int(self.env.observation_spec["observation"].shape[-1])

    def reset(self, seed: int) -> np.ndarray:
        """See :class:`SingleEnv`."""
        # Some draw from torch's global generator; a policy's draws must not start over.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.env.set_seed(seed)
            self._state = self.env.reset()
        return self._observed(self._state)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """See :class:`SingleEnv`."""
        given = torch.from_numpy(action).reshape(self.env.action_spec.shape)
        data = self.env.step(self._state.set("action", given))
        self._state = step_mdp(data)
        stepped = data["next"]
        ended, truncated = bool(stepped["done"].any()), stepped.get("truncated", None)
        late = truncated is not None and bool(truncated.any())
        terminated = stepped.get("terminated", None)
        over = ended and not late if terminated is None else bool(terminated.any())
        late = late or (ended and not over)
        return self._observed(stepped), _number(self._name, stepped["reward"]), over, late

    def _observed(self, data: TensorDictBase) -> np.ndarray:
        observation: np.ndarray = data["observation"].reshape(-1).float().numpy().copy()
        return observation

    def time_step(self) -> float | None:
        """See :class:`SingleEnv`."""
        return time_step(self.env)

    def horizon(self) -> int | None:
        """See :class:`SingleEnv`."""
        env: EnvBase = self.env
        limits: list[Any] = []
        frames = 1
        while isinstance(env, TransformedEnv):
            chain = list(env.transform.modules())
            # They count the frames requested, however many a step takes.
            limits += [t.max_steps for t in chain if isinstance(t, StepCounter)]
            frames *= math.prod(t.frame_skip for t in chain if isinstance(t, FrameSkipTransform))
            env = env.base_env
        if not isinstance(env, BatchedEnvBase):  # which would ask its members
            inner = getattr(env, "_env", None)  # Gymnasium's or dm_control's
            spec = getattr(inner, "spec", None)
            is_single = isinstance(inner, gymnasium.Env)
            told = [
                getattr(env, "max_steps", None),
                getattr(inner, "_step_limit", None),
                _time_limit(inner) if is_single else getattr(spec, "max_episode_steps", None),
            ]
            skipped = frames * getattr(env, "wrapper_frame_skip", 1)
            limits += [_in_steps(limit, skipped) for limit in told]
        return min((limit for limit in limits if _is_limit(limit)), default=None)

    def outcome(self) -> Outcome | None:
        """See :class:`SingleEnv`."""
        return None

    def close(self) -> None:
        """See :class:`SingleEnv`."""
        self.env.close(raise_if_closed=False)


def _number(name: str, reward: Any) -> float:
    """A reward, which some environments return as an array with one number."""
    earned = np.asarray(reward, dtype=np.float64)
    if earned.size != 1:
        raise ValueError(
            f"{name} returned a reward of shape {earned.shape}; one number is needed: sum them, or "
            "choose one, in a wrapper or transform"
        )
    return earned.item()


def _copied(original: Any, memo: dict[int, Any]) -> Any:
    """A deep copy by attributes."""
    copied = memo[id(original)] = object.__new__(type(original))
    copied.__dict__.update(deepcopy(original.__dict__, memo))
    return copied


def _is_limit(limit: object) -> bool:
    return isinstance(limit, (int, float)) and 0 < limit < math.inf


def _in_steps(limit: Any, frames: int) -> int | None:
    """A limit in steps, from one in frames, of which a step takes several."""
    return math.ceil(limit / frames) if _is_limit(limit) else None


def _time_limit(env: Any) -> int | None:
    """Steps of an episode of a Gymnasium environment, by its shortest time limit."""
    spec, frames = env.spec, 1
    told = []
    while env is not env.unwrapped:
        frames *= repeats(env)
        told.append(_in_steps(env.__dict__.get("_max_episode_steps"), frames))
        env = env.env
    found = [limit for limit in told if limit is not None]
    return min(found, default=None if spec is None else spec.max_episode_steps)


def _no_actions(name: str, found: object) -> str:
    return (
        f"{name} has {found} as actions; planning, policies and L1 need a vector of continuous "
        f"ones ({PAGE})"
    )


def _unbounded(name: str, found: str) -> str:
    return (
        f"{name} has unbounded actions ({found}); planning and random data need bounds: give its "
        f"action space some, or wrap it ({PAGE})"
    )


def _checked_bounds(name: str, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = low.astype(np.float32), high.astype(np.float32)
    if not (np.abs(low) < LARGEST_BOUND).all() or not (np.abs(high) < LARGEST_BOUND).all():
        raise ValueError(_unbounded(name, f"{low.tolist()} to {high.tolist()}"))
    if not (low < high).all():
        raise ValueError(f"{name} has empty action bounds: {low.tolist()} to {high.tolist()}")
    return low, high


def _is_vector(space: Space[Any]) -> TypeGuard[Box]:
    """Whether a spec is a vector of floating-point numbers, or one such number."""
    if not isinstance(space, Box) or not np.issubdtype(space.dtype, np.floating):
        return False
    return len(space.shape) <= 1


def _whole(name: str, parts: Sequence[str], left_out: Sequence[str]) -> tuple[str, ...]:
    """All parts of an observation in the order of their names, unless a choice is needed."""
    if not parts:
        raise ValueError(
            f"{name} has no vectors in its observations; a vector of numbers is needed ({PAGE})"
        )
    if left_out:
        raise ValueError(f"{name}: {unclear(left_out, parts)} ({PAGE})")
    if "observation" in parts and len(parts) > 1:
        raise ValueError(
            f"{name} has the observations {', '.join(sorted(parts))}: say which make the state, "
            f"such as observation_keys=[{','.join(parts)}] ({PAGE})"
        )
    return tuple(sorted(parts))
