"""Particles: the draws that move them, their motion through the ensemble, and their returns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from torchrl_l1.dynamics.functions import RewardFunction, Termination, one_each
from torchrl_l1.dynamics.network import ForwardPass, PlanningNetwork

Scenarios = tuple[Tensor, Tensor]
"""Members ``(H, P)`` and noise ``(H, n, P)`` drawn for the particles of all candidates."""


def scenarios(
    network: PlanningNetwork,
    particles: int,
    horizon: int,
    generator: torch.Generator | None,
    like: Tensor,
) -> Scenarios:
    """Draw the members and noise common to all candidates, on the device of ``like``."""
    size, device = (horizon, network.observation_dim, particles), like.device
    members = torch.randint(
        network.members, (horizon, particles), generator=generator, device=device
    )
    return members, torch.randn(size, generator=generator, device=device, dtype=torch.float32)


class Draws:
    """Random numbers of B trajectories, sorted by member, candidate and particle.

    Args:
        network: the members.
        shares: particles of each member, see :func:`member_shares`.
        count: number of trajectories, B.
        horizon: number of steps.
        common: the draws that all candidates share; each has its own if ``None``.
        generator: source of randomness; torch's global one if ``None``.
    """

    def __init__(
        self,
        network: PlanningNetwork,
        shares: list[int],
        count: int,
        horizon: int,
        common: Scenarios | None,
        generator: torch.Generator | None,
    ) -> None:
        self._network, self._count, self._horizon = network, count, horizon
        self._common, self._generator = common, generator
        self.device = network.bias.device
        if common is not None:
            every = torch.arange(sum(shares), device=self.device).split(shares)
            candidates = count // sum(shares)
            self._particle = torch.cat([own.repeat(candidates) for own in every])

    def members(self) -> Tensor:
        """The member for every step and trajectory ``(H, B)``."""
        if self._common is not None:
            return self._common[0][:, self._particle]
        return torch.randint(
            self._network.members,
            (self._horizon, self._count),
            generator=self._generator,
            device=self.device,
        )

    def noise(self, step: int, order: Tensor | None = None) -> Tensor | None:
        """Standard normal numbers ``(B, n)`` of a step, stored column by column.

        ``order`` says for which trajectories they are; ``None`` if none are needed.
        """
        if self._network.standard_deviation is None:
            return None
        if self._common is not None:
            particle = self._particle if order is None else self._particle[order]
            return self._common[1][step].index_select(1, particle).t()
        size = (self._network.observation_dim, self._count)
        kind = torch.float32
        return torch.randn(size, generator=self._generator, device=self.device, dtype=kind).t()


Propagation = Literal["ts1", "tsinf", "mean"]

Predict = Callable[[Tensor, int], Tensor]
"""Normalised change ``(B, n)`` from raw inputs ``(B, n + m)`` at a step."""


def member_shares(network: PlanningNetwork, particles: int, propagation: Propagation) -> list[int]:
    """Number of particles per member; not assigned to members unless they keep theirs."""
    if propagation == "tsinf":
        return [len(range(member, particles, network.members)) for member in range(network.members)]
    return [1 if propagation == "mean" else particles]


def predictor(
    network: PlanningNetwork,
    propagation: Propagation,
    shares: list[int],
    count: int,
    draws: Draws,
) -> Predict:
    """The prediction for B = ``count`` trajectories, in the order of their draws."""
    k = network.members
    if propagation == "mean":
        everyone = ForwardPass(network, [count] * k, shared=True)

        def mean(inputs: Tensor, step: int) -> Tensor:
            changes = everyone(inputs)[:, : network.observation_dim]
            return changes.unflatten(0, (k, count)).mean(0)

        return mean
    if propagation == "tsinf":
        candidates = count // sum(shares)
        keeping = ForwardPass(network, [candidates * share for share in shares])
        return lambda inputs, step: network.sample(keeping(inputs), draws.noise(step))
    drawn = draws.members()
    order = drawn.argsort(1)
    sizes = torch.stack([(drawn == member).sum(1) for member in range(k)], 1).tolist()
    memory: dict[tuple[torch.dtype, int], Tensor] = {}

    def switching(inputs: Tensor, step: int) -> Tensor:
        # Rows of the same member are next to each other while the products are computed.
        raw = ForwardPass(network, sizes[step], memory=memory)(inputs[order[step]])
        result = torch.empty_like(inputs[:, : network.observation_dim])
        result[order[step]] = network.sample(raw, draws.noise(step, order[step]))
        return result

    return switching


def imagined_returns(
    network: PlanningNetwork,
    predict: Predict,
    x: Tensor,
    u: Tensor,
    reward: RewardFunction,
    terminated: Termination | None,
    discount: float,
) -> Tensor:
    """Returns ``(B,)`` of trajectories from ``(B, n)`` under actions ``(H, B, m)``.

    See :func:`torchrl_l1.planning.evaluate`, also for the errors.
    """
    horizon, n = u.shape[0], x.shape[1]
    # Stored column by column, so that all operations on a state work on whole columns.
    inputs = x.new_empty(horizon + 1, n + u.shape[2], x.shape[0]).transpose(1, 2)
    states = inputs[..., :n]
    states[0] = x
    inputs[:-1, :, n:] = u
    for t in range(horizon):
        change = predict(inputs[t], t)
        torch.addcmul(states[t], change, network.change_std, out=states[t + 1])
        states[t + 1] += network.change_mean
    # Rewards may be integers or booleans; discounts and means are not.
    rewards = one_each(reward, "reward", states[:-1], u, states[1:]).to(u.dtype)
    if terminated is None:
        # A non-finite state stays non-finite, so checking the last one suffices.
        sound = torch.isfinite(states[-1]).all(-1)
    else:
        ended = one_each(terminated, "terminated", states[1:]).bool().long()
        over = (ended.cumsum(0) - ended) > 0
        rewards = torch.where(over, 0.0, rewards)
        sound = (torch.isfinite(states[1:]).all(-1) | over).all(0)
    if discount != 1:
        rewards = rewards * rewards.new_tensor([[discount**t] for t in range(horizon)])
    returns = rewards.sum(0)
    return torch.where(sound & torch.isfinite(returns), returns, -torch.inf)
