"""Imagined trajectories: a direct loop, and the model as a TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_l1.checks import check_choice, check_count
from torchrl_l1.dynamics.functions import (
    RewardFunction,
    Termination,
    checked_bounds,
    finite_bounds,
    one_each,
    untouched,
)
from torchrl_l1.dynamics.model import EnsembleDynamics
from torchrl_l1.dynamics.network import ForwardPass, PlanningNetwork, Precision


@torch.no_grad()
def imagine(
    dynamics: EnsembleDynamics,
    policy: Callable[[Tensor], Tensor],
    reward: RewardFunction,
    start: Tensor,
    horizon: int,
    action_low: Tensor,
    action_high: Tensor,
    terminated: Termination | None = None,
    precision: Precision = "float32",
) -> TensorDict:
    """Roll a policy out in the ensemble, one random member per step for the whole batch.

    A trajectory that leaves the box around the data ends there: the model knows nothing outside,
    and rewards imagined there grow without bound. Entries that never varied in the data stay as
    they are. Model and reward see the clipped action; what is stored is the policy's sample, since
    the policy gradient needs its likelihood.

    The model is copied once, with its statistics folded into the weights; rewards and terminations
    are computed for all steps at once.

    Args:
        dynamics: the model; at each step one of its elites is drawn (arXiv 1802.10592), and its
            mean is used.
        policy: maps observations ``(B, n)`` to sampled actions ``(B, m)``.
        reward: maps rows of observations, clipped actions and next observations to one number per
            row.
        start: first observations ``(B, n)``.
        horizon: number of steps, T.
        action_low: lower bounds ``(m,)``.
        action_high: upper bounds ``(m,)``.
        terminated: whether the task ends in a next observation, ``(rows, n)`` to ``(rows,)``; never
            by default.
        precision: of the hidden layers, see :class:`~torchrl_l1.planning.PlanningNetwork`.

    Returns:
        trajectories of batch size ``[B, T]`` with ``observation``, ``action``, ``step`` ``(B, T,
        1)``, ``valid`` ``(B, T, 1)`` (not ended before the step) and ``next``: ``observation``,
        ``reward``, ``done``, ``left_box`` and ``terminated``. Whatever follows a ``done`` step is
        not valid and has no meaning; its rewards are zero.

    Raises:
        ValueError: for no steps, start states of the wrong shape, bounds that are empty or of the
            wrong width, a policy that does not give one action per row, a reward or termination
            that is not one number per row, or a function that writes to its inputs.
    """
    n, m = dynamics.observation_dim, dynamics.action_dim
    check_count("horizon", horizon)
    if start.dim() != 2 or start.shape[1] != n:
        raise ValueError(f"start must have shape (B, {n}) for this model, got {tuple(start.shape)}")
    batch, device = start.shape[0], start.device
    network = PlanningNetwork.from_dynamics(dynamics, precision)
    drawn = torch.randint(network.members, (horizon,)).tolist()
    memory: dict[tuple[torch.dtype, int], Tensor] = {}
    passes = {member: _forward_pass(network, batch, member, memory) for member in set(drawn)}
    action_low, action_high = checked_bounds(action_low, action_high, start.new_empty(m))
    observations = start.new_empty(horizon + 1, batch, n)
    predicted = start.new_empty(horizon, batch, n)
    actions = start.new_empty(horizon, batch, m)
    inputs = network.bias.new_empty(batch, n + m)
    box = dynamics.box
    holds = bool(box.fixed.any())
    observations[0] = observation = start
    for t, member in enumerate(drawn):
        action = untouched(policy, "policy", observation)
        if action.shape != (batch, m):
            raise ValueError(
                f"the policy must give actions ({batch}, {m}) for observations ({batch}, {n}), got "
                f"{tuple(action.shape)}"
            )
        actions[t] = action
        inputs[:, :n] = observation
        inputs[:, n:] = actions[t].clamp(action_low, action_high)
        change = passes[member](inputs)[:, :n]
        torch.addcmul(
            observation + network.change_mean, change, network.change_std, out=predicted[t]
        )
        if holds:
            predicted[t] = box.hold(observation, predicted[t])
        # Clamped for now, so that nothing overflows.
        observation = torch.clamp(predicted[t], box.low, box.high, out=observations[t + 1])
    inside = (predicted == observations[1:]).all(-1)  # NaN is not
    if not inside.all():
        # A trajectory that left stays in its last state inside, with its action there: outside,
        # neither state nor reward mean anything.
        last = inside.cumprod(0).sum(0)
        place = torch.arange(horizon + 1, device=device)[:, None].minimum(last)[..., None]
        observations = observations.gather(0, place.expand(-1, -1, n))
        actions = actions.gather(0, place[:-1].expand(-1, -1, m))
    successors = observations[1:].flatten(0, 1)
    rewards = one_each(
        reward,
        "reward",
        observations[:-1].flatten(0, 1),
        actions.flatten(0, 1).clamp(action_low, action_high),
        successors,
    )
    rewards = rewards.to(start.dtype).unflatten(0, (horizon, batch))
    fallen = torch.zeros_like(inside)
    if terminated is not None:
        fallen = one_each(terminated, "terminated", successors).bool()
        fallen = fallen.unflatten(0, (horizon, batch))
    ended = (~inside | fallen).long()
    valid = (ended.cumsum(0) - ended) == 0
    done = valid & ended.bool()
    left, fell = done & ~inside, done & inside
    # Nothing is earned after the end; multiplying by zero would keep NaN.
    rewards = torch.where(valid, rewards, 0.0)
    done[-1] = True
    columns = {
        "observation": observations[:-1],
        "action": actions,
        "step": torch.arange(horizon, device=device)[:, None, None].expand(-1, batch, 1),
        "valid": valid[..., None],
        "next": {
            "observation": observations[1:],
            "reward": rewards[..., None],
            "done": done[..., None],
            "left_box": left[..., None],
            "terminated": fell[..., None],
        },
    }
    return TensorDict(columns, batch_size=[horizon, batch]).transpose(0, 1)


def _forward_pass(
    network: PlanningNetwork,
    batch: int,
    member: int,
    memory: dict[tuple[torch.dtype, int], Tensor],
) -> ForwardPass:
    """A forward pass of one member alone."""
    rows = [0] * network.members
    rows[member] = batch
    return ForwardPass(network, rows, memory=memory)


class EnsembleWorldModel(TensorDictModuleBase):
    """One imagined step as a TensorDictModule: next observation, reward and ends.

    Args:
        dynamics: the ensemble.
        reward: maps observation, action and next observation to ``(...)``.
        propagation: ``"mean"`` of the ensemble, or a ``"random_member"`` of its elites in each
            call.
        terminated: maps next observations to whether the task ends there ``(...)``; never if
            ``None``.
        box_exit: what leaving the box around the data does: ``"fail"`` terminates the episode,
            which is worth nothing from then on; ``"truncate"`` truncates it where the model ends.
    """

    in_keys = ["observation", "action"]  # noqa: RUF012
    out_keys = ["observation", "reward", "terminated", "truncated", "done"]  # noqa: RUF012

    def __init__(
        self,
        dynamics: EnsembleDynamics,
        reward: RewardFunction,
        propagation: str = "mean",
        terminated: Termination | None = None,
        box_exit: str = "fail",
    ) -> None:
        super().__init__()
        check_choice("propagation", propagation, ("mean", "random_member"))
        check_choice("box_exit", box_exit, ("fail", "truncate"))
        self.dynamics = dynamics
        self.reward = reward
        self.propagation = propagation
        self.terminated = terminated
        self.box_exit = box_exit

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Overwrite ``observation`` with the next one and write the reward and ends."""
        observation, action = tensordict["observation"], tensordict["action"]
        if self.propagation == "mean":
            change = self.dynamics.mean_change(observation, action)
        else:
            elites = self.dynamics.elites.tolist()
            member = elites[int(torch.randint(len(elites), ()))]
            change = self.dynamics.member_change(
                observation.reshape(-1, observation.shape[-1]),
                action.reshape(-1, action.shape[-1]),
                member,
            ).reshape(observation.shape)
        successor = self.dynamics.box.hold(observation, observation + change)
        left = ~self.dynamics.box.contains(successor).unsqueeze(-1)
        # Outside, neither state nor reward mean anything.
        successor = torch.where(left, observation, successor)
        reward = one_each(self.reward, "reward", observation, action, successor)
        fallen = torch.zeros_like(left)
        if self.terminated is not None:
            fallen = one_each(self.terminated, "terminated", successor).bool().unsqueeze(-1) & ~left
        ends = self.box_exit == "fail"
        return tensordict.update(
            {
                "observation": successor,
                "reward": reward.to(change).unsqueeze(-1),
                "terminated": fallen | left if ends else fallen,
                "truncated": torch.zeros_like(left) if ends else left,
                "done": fallen | left,
            }
        )


class EnsembleModelEnv(ModelBasedEnvBase):
    """A learned ensemble as an environment for TorchRL's rollouts, collectors and planners.

    An episode ends where the task does, and where the state leaves the box around the model's data.
    In the latter case it ends in its last state inside, for which that step's reward is computed.
    Model and reward see the action within its bounds. For the inner loop of an algorithm
    :func:`~torchrl_l1.dynamics.imagine` is faster; it draws a member per step.

    Args:
        dynamics: the ensemble.
        reward: maps observation, action and next observation to ``(...)``.
        start: draws initial observations, ``count -> (count, n)``.
        action_low: lower bound of the actions, a single number or one per entry.
        action_high: upper bound.
        batch_size: shape of the batch of environments; ``()`` for planners, which add their own.
        propagation: see :class:`EnsembleWorldModel`, also for the next two.
        terminated: where the task ends.
        box_exit: what leaving the box does.

    Raises:
        ValueError: for bounds that are empty, not finite or of the wrong width, or an unknown
            choice; at a reset or step, for initial observations, rewards or terminations of the
            wrong shape.

    Examples:
        >>> model = EnsembleDynamics(3, 1, members=2, hidden=(8,))
        >>> env = EnsembleModelEnv(
        ...     model,
        ...     reward=lambda x, u, successor: -x.square().sum(-1),
        ...     start=lambda count: torch.zeros(count, 3),
        ...     action_low=-1.0,
        ...     action_high=1.0,
        ...     batch_size=(4,),
        ... )
        >>> env.rollout(5)["next", "reward"].shape
        torch.Size([4, 5, 1])
    """

    def __init__(
        self,
        dynamics: EnsembleDynamics,
        reward: RewardFunction,
        start: Callable[[int], Tensor],
        action_low: float | Sequence[float] | Tensor,
        action_high: float | Sequence[float] | Tensor,
        batch_size: tuple[int, ...] = (),
        propagation: str = "mean",
        terminated: Termination | None = None,
        box_exit: str = "fail",
    ) -> None:
        device = next(dynamics.parameters()).device
        super().__init__(
            EnsembleWorldModel(dynamics, reward, propagation, terminated, box_exit),
            device=device,
            batch_size=torch.Size(batch_size),
        )
        self.start = start
        n, m = dynamics.observation_dim, dynamics.action_dim
        kind: dict[str, Any] = {"device": device, "dtype": dynamics.change_normalizer.mean.dtype}
        self.observation_spec = Composite(
            observation=Unbounded((*batch_size, n), **kind), shape=batch_size, device=device
        )
        self.state_spec = self.observation_spec.clone()
        low, high = finite_bounds(action_low, action_high, torch.empty(m, **kind))
        shape = (*batch_size, m)
        self.action_spec = Bounded(low.expand(shape), high.expand(shape), shape, **kind)
        self.reward_spec = Unbounded((*batch_size, 1), **kind)
        flag = Binary(1, (*batch_size, 1), dtype=torch.bool, device=device)
        self.full_done_spec = Composite(
            {name: flag.clone() for name in ("done", "terminated", "truncated")},
            shape=batch_size,
            device=device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        space = self.action_spec.space
        clipped = tensordict["action"].clamp(space.low, space.high)
        return super()._step(tensordict.copy().set("action", clipped))

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDict:
        shape = self.batch_size if tensordict is None else tensordict.shape
        spec = self.observation_spec["observation"]
        count = max(1, shape.numel())
        observation = self.start(count).to(self.device, spec.dtype)
        if observation.shape != (count, spec.shape[-1]):
            raise ValueError(
                f"start({count}) must give observations ({count}, {spec.shape[-1]}), got "
                f"{tuple(observation.shape)}"
            )
        return TensorDict(
            {"observation": observation.reshape(*shape, -1)},
            batch_size=shape,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        # All random numbers come from torch's global generator.
        if seed is not None:
            torch.manual_seed(seed)
