r"""Rewards and terminations of known Gymnasium tasks, as functions of the observation.

They are for imagination, where nothing but the observation exists. Weights and ranges are those of
the given environment. Most are exact; if the reward uses the displacement of a body whose position
is not in the observation, it is computed from the velocities before and after the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import mujoco
import torch
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from torch import Tensor

from torchrl_l1.envs.gymnasium_env import MujocoTaskEnv
from torchrl_l1.envs.task import RewardFn, never

_PASSIVE = (OrderEnforcing, PassiveEnvChecker, TimeLimit)

# Length of each pole of the inverted double pendulum, metres.
_POLE = 0.6


@dataclass(frozen=True)
class Outcome:
    """Reward and termination of a step as functions of the observation.

    Attributes:
        reward: ``(observation (..., n), action (..., m), next_observation (..., n)) -> (...)``.
        terminated: ``next_observation (..., n) -> bool (...)``.
        note: why the reward is not exact, if it is not.
    """

    reward: RewardFn
    terminated: Callable[[Tensor], Tensor] = never
    note: str = ""

    @property
    def terminates(self) -> bool:
        """Whether any state ends an episode."""
        return self.terminated is not never


def known_outcome(env: gymnasium.Env[Any, Any]) -> Outcome | None:
    """Reward and termination of one of Gymnasium's own environments.

    Args:
        env: as returned by :func:`gymnasium.make`. Wrappers that may change observation, action or
            reward make it a different environment.

    Returns:
        ``None`` for an unknown environment.

    Examples:
        >>> pendulum = known_outcome(gymnasium.make("Pendulum-v1"))
        >>> hanging = torch.tensor([-1.0, 0.0, 0.0])
        >>> pendulum.reward(hanging, torch.zeros(1), hanging)
        tensor(-9.8696)
    """
    inner: Any = env.unwrapped
    while env is not inner:
        if type(env) not in _PASSIVE:
            return None
        env = env.env  # type: ignore[attr-defined]
    if type(inner) is MujocoTaskEnv:
        return Outcome(inner.task.imagined_reward, inner.task.terminated)
    builder = _BUILDERS.get(f"{type(inner).__module__}.{type(inner).__name__}")
    return None if builder is None else builder(inner)


def _pendulum(env: Any) -> Outcome:
    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        angle = torch.atan2(observation[..., 1], observation[..., 0])
        torque = action[..., 0].clamp(-env.max_torque, env.max_torque)
        speed = observation[..., 2]
        return -(angle.square() + 0.1 * speed.square() + 0.001 * torque.square())

    return Outcome(reward)


def _mountain_car(env: Any) -> Outcome:
    def arrived(following: Tensor) -> Tensor:
        fast = following[..., 1] >= env.goal_velocity
        return (following[..., 0] >= env.goal_position) & fast

    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        return 100.0 * arrived(following).to(following) - 0.1 * action[..., 0].square()

    return Outcome(reward, arrived)


def _inverted_pendulum(env: Any) -> Outcome:
    def fallen(following: Tensor) -> Tensor:
        return (following[..., 1].abs() > 0.2) | ~following.isfinite().all(-1)

    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        return (~fallen(following)).to(following)

    return Outcome(reward, fallen)


def _double_pendulum(env: Any) -> Outcome:
    def tip(following: Tensor) -> tuple[Tensor, Tensor]:
        x, s1, s2, c1, c2 = following[..., :5].unbind(-1)
        across = x + _POLE * (s1 + s1 * c2 + c1 * s2)
        return across, _POLE * (c1 + c1 * c2 - s1 * s2)

    def fallen(following: Tensor) -> Tensor:
        return tip(following)[1] <= 1

    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        x, y = tip(following)
        first, second = following[..., 6], following[..., 7]
        distance = 0.01 * x.square() + (y - 2).square()
        speed = 1e-3 * first.square() + 5e-3 * second.square()
        return env._healthy_reward * (y > 1).to(y) - distance - speed

    return Outcome(
        reward, fallen, "angular velocities beyond 10 rad/s are clipped in the observation"
    )


def _reacher(env: Any) -> Outcome:
    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        distance = following[..., 8:10].norm(dim=-1)
        effort = action.square().sum(-1)
        return -env._reward_dist_weight * distance - env._reward_control_weight * effort

    return Outcome(reward)


def _pusher(env: Any) -> Outcome:
    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        tip, object_, goal = (following[..., i : i + 3] for i in (14, 17, 20))
        near, far = (object_ - tip).norm(dim=-1), (object_ - goal).norm(dim=-1)
        effort = action.square().sum(-1)
        return -(
            env._reward_near_weight * near
            + env._reward_dist_weight * far
            + env._reward_control_weight * effort
        )

    return Outcome(reward)


def _forward(env: Any, left_out: int, root: int) -> tuple[RewardFn, str]:
    """Weighted forward speed of a body minus the cost of the action, and why it is not exact.

    Args:
        env: the environment.
        left_out: positions that the observation leaves out, if any.
        root: index of the forward velocity among all velocities.
    """
    hidden = env._exclude_current_positions_from_observation
    weight, cost = env._forward_reward_weight, env._ctrl_cost_weight
    place = env.model.nq - (left_out if hidden else 0) + root
    steps = env.frame_skip
    # The mean velocity of a step: for positions that follow each new velocity (semi-implicit), or
    # for the whole motion (Runge-Kutta), given a velocity that changes evenly.
    semi_implicit = env.model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
    after = (steps + 1) / (2 * steps) if semi_implicit else 0.5

    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        if hidden:
            speed = (1 - after) * observation[..., place] + after * following[..., place]
        else:
            speed = (following[..., 0] - observation[..., 0]) / env.dt
        return weight * speed - cost * action.square().sum(-1)

    note = "the forward speed is taken from the velocities before and after the step"
    return reward, note if hidden else ""


def _half_cheetah(env: Any) -> Outcome:
    reward, note = _forward(env, left_out=1, root=0)
    return Outcome(reward, note=note)


def _swimmer(env: Any) -> Outcome:
    reward, note = _forward(env, left_out=2, root=0)
    return Outcome(reward, note=note)


def _walking(env: Any, healthy: Callable[[Tensor], Tensor]) -> Outcome:
    """A runner that earns a bonus while it is healthy, and may end when it is not."""
    forward, note = _forward(env, left_out=1, root=0)

    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        alive = healthy(following).to(following)
        return forward(observation, action, following) + env._healthy_reward * alive

    def fallen(following: Tensor) -> Tensor:
        return ~healthy(following)

    return Outcome(reward, fallen if env._terminate_when_unhealthy else never, note)


def _walker(env: Any) -> Outcome:
    first = 0 if env._exclude_current_positions_from_observation else 1
    return _walking(env, lambda following: _upright(env, following, first))


def _hopper(env: Any) -> Outcome:
    first = 0 if env._exclude_current_positions_from_observation else 1
    low, high = env._healthy_state_range

    def healthy(following: Tensor) -> Tensor:
        state = following[..., first + 1 :]
        return _upright(env, following, first) & ((state > low) & (state < high)).all(-1)

    return _walking(env, healthy)


def _upright(env: Any, following: Tensor, first: int) -> Tensor:
    height, angle = following[..., first], following[..., first + 1]
    (low, high), (left, right) = env._healthy_z_range, env._healthy_angle_range
    return (height > low) & (height < high) & (angle > left) & (angle < right)


def _ant(env: Any) -> Outcome | None:
    if env._contact_cost_weight and not env._include_cfrc_ext_in_observation:
        return None  # the contact forces cost something and are not seen
    forward, note = _forward(env, left_out=2, root=0)
    first = 0 if env._exclude_current_positions_from_observation else 2
    low, high = env._healthy_z_range
    forces = env.observation_structure["cfrc_ext"]

    def healthy(following: Tensor) -> Tensor:
        height = following[..., first]
        return (height >= low) & (height <= high) & following.isfinite().all(-1)

    def reward(observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        contact = following[..., following.shape[-1] - forces :].square().sum(-1)
        alive = healthy(following).to(following)
        earned = forward(observation, action, following) + env._healthy_reward * alive
        return earned - env._contact_cost_weight * contact

    def fallen(following: Tensor) -> Tensor:
        return ~healthy(following)

    if not note:
        note = "the forward speed is that of the torso one substep earlier"
    if env._contact_cost_weight:
        note += ", and contact forces have a cost but are not observed"
    return Outcome(reward, fallen if env._terminate_when_unhealthy else never, note)


_CONTROL, _MUJOCO = "gymnasium.envs.classic_control", "gymnasium.envs.mujoco"
_BUILDERS: dict[str, Callable[[Any], Outcome | None]] = {
    f"{_CONTROL}.pendulum.PendulumEnv": _pendulum,
    f"{_CONTROL}.continuous_mountain_car.Continuous_MountainCarEnv": _mountain_car,
    f"{_MUJOCO}.inverted_pendulum_v5.InvertedPendulumEnv": _inverted_pendulum,
    f"{_MUJOCO}.inverted_double_pendulum_v5.InvertedDoublePendulumEnv": _double_pendulum,
    f"{_MUJOCO}.reacher_v5.ReacherEnv": _reacher,
    f"{_MUJOCO}.pusher_v5.PusherEnv": _pusher,
    f"{_MUJOCO}.half_cheetah_v5.HalfCheetahEnv": _half_cheetah,
    f"{_MUJOCO}.swimmer_v5.SwimmerEnv": _swimmer,
    f"{_MUJOCO}.hopper_v5.HopperEnv": _hopper,
    f"{_MUJOCO}.walker2d_v5.Walker2dEnv": _walker,
    f"{_MUJOCO}.ant_v5.AntEnv": _ant,
}
