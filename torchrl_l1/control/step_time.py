"""How long a step of an environment takes, as far as it declares that."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
from torchrl.envs import EnvBase, FrameSkipTransform, PendulumEnv, SerialEnv, TransformedEnv

# By convention, wrappers of Gymnasium that repeat an action keep the number under one of these.
_REPEATS = ("_skip", "skip", "_frame_skip", "frame_skip", "action_repeat")

_TOLERANCE = 1e-4


def time_step(env: EnvBase | gymnasium.Env[Any, Any]) -> float | None:
    """Time of one step of an environment in seconds; ``None`` if it does not declare it.

    Read from an attribute ``dt`` of the environment, of its ``task`` or of the Gymnasium
    environment inside, or from ``control_timestep`` of dm_control, times the frames that wrappers
    and transforms skip. Environments in other processes are not asked. A Gymnasium environment may
    also be given directly.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> time_step(GymEnv("Pendulum-v1", frame_skip=2))
        0.1
    """
    if isinstance(env, gymnasium.Env):
        return _of_wrapped(env)
    if isinstance(env, TransformedEnv):
        inner = time_step(env.base_env)
        for transform in env.transform.modules():
            if inner is not None and isinstance(transform, FrameSkipTransform):
                inner *= transform.frame_skip
        return inner
    if isinstance(env, SerialEnv):
        members = env.__dict__.get("_envs", [])
        found = {time_step(member) for member in members}
        return found.pop() if len(found) == 1 else None
    if isinstance(env, PendulumEnv):
        return float(env.gen_params()["params", "dt"])
    wrapped = env.__dict__.get("_env", None)
    if wrapped is None:
        return _told(env)
    inner = _of_wrapped(wrapped)
    return None if inner is None else inner * getattr(env, "wrapper_frame_skip", 1)


def _of_wrapped(env: Any) -> float | None:
    control_timestep = getattr(env, "control_timestep", None)
    if callable(control_timestep):
        return _number(control_timestep())
    vector = getattr(env, "envs", None)
    if isinstance(vector, (list, tuple)) and vector:
        return _of_wrapped(vector[0])
    frames = 1
    while getattr(env, "env", None) is not None and hasattr(env, "unwrapped"):
        if env is env.unwrapped:
            break
        frames *= repeats(env)
        env = env.env
    told = _told(env)
    return None if told is None else told * frames


def repeats(wrapper: Any) -> int:
    """How often a wrapper of Gymnasium repeats an action, by the conventional attribute.

    Examples:
        >>> from types import SimpleNamespace
        >>> repeats(SimpleNamespace(frame_skip=4)), repeats(SimpleNamespace())
        (4, 1)
    """
    skips = [wrapper.__dict__.get(name) for name in _REPEATS]
    return next((skip for skip in skips if type(skip) is int and skip > 0), 1)


def _told(env: Any) -> float | None:
    try:
        dt = getattr(env, "dt", None)
        return _number(getattr(getattr(env, "task", None), "dt", None) if dt is None else dt)
    except Exception:  # an environment's own attributes may fail as they like
        return None


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def check_time_step(owner: str, dt: float, env: EnvBase, *, was_given: bool = True) -> None:
    """Reject a ``dt`` that differs from the environment's, if that declares its own.

    Args:
        owner: name of the class with the ``dt``.
        dt: in seconds.
        env: the environment.
        was_given: whether the ``dt`` was given, and not that of another environment.

    Raises:
        ValueError: naming both.
    """
    told = time_step(env)
    if told is not None and abs(dt - told) > _TOLERANCE * told:
        if not was_given:
            raise ValueError(
                f"{owner} took dt={dt:.6g} from an environment before, but a step of this one "
                f"takes {told:.6g} s: make one {owner} for each time step"
            )
        raise ValueError(
            f"{owner} has dt={dt:.6g}, but a step of the environment takes {told:.6g} s: leave dt "
            "out, give that value, or give check_dt=False if the environment is wrong"
        )
