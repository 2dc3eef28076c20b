"""Trajectory sampling: returns of action sequences, by particles through an ensemble."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Literal, get_args

import torch
from torch import Tensor

from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.planning.network import (
    ForwardPass,
    PlanningNetwork,
    Precision,
    resolve_precision,
)
from torchrl_l1.planning.sequences import Evaluate

Propagation = Literal["ts1", "tsinf", "mean"]
RewardFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
Termination = Callable[[Tensor], Tensor]

# Trajectories that go through the horizon together: enough of them to make little of what a call
# costs, and no more than a processor's caches hold. Elsewhere it only bounds the memory.
_CPU_BLOCK = 8000
_OTHER_BLOCK = 131_072

_Predict = Callable[[Tensor, int], Tensor]


@torch.no_grad()
def evaluate(
    dynamics: EnsembleDynamics | PlanningNetwork,
    observation: Tensor,
    actions: Tensor,
    reward: RewardFunction,
    *,
    particles: int = 20,
    propagation: Propagation = "tsinf",
    terminated: Termination | None = None,
    common_noise: bool = False,
    precision: Precision = "float32",
    block: int | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Mean over particles of the undiscounted sum of imagined rewards.

    How a particle travels (arXiv 1805.12114, section 5):

    - ``"tsinf"``: particle :math:`p` keeps elite :math:`p \bmod k` for the whole horizon, so
      that any number of particles will do, but fewer than k leave elites out;
    - ``"ts1"``: every particle draws an elite at every step;
    - ``"mean"``: one particle, whatever ``particles``, moved by the mean of the elites' mean
      changes.

    With ``"tsinf"`` and ``"ts1"`` the change is sampled from the member's distribution if its
    head has one. A particle earns the reward of the step that terminates it, and nothing after
    it: where rewards are negative, shift them, or ending early pays. A particle with a state or
    reward that is not finite, before it terminates, makes the return of its candidate minus
    infinity.

    Args:
        dynamics: the model, or a snapshot of it, which is taken as it is.
        observation: where the N environments are ``(N, n)``.
        actions: candidate sequences ``(N, C, H, m)``; they are not clipped.
        reward: maps observations ``(..., n)``, actions ``(..., m)`` and next observations to
            ``(...)``; it sees whole trajectories at once.
        particles: trajectories per candidate, P.
        propagation: see above.
        terminated: maps next observations ``(..., n)`` to booleans ``(...)``; never if ``None``.
        common_noise: let particle p of every candidate meet the same draws of members and of noise
            (common random numbers, arXiv 1301.3878), instead of its own. Each return has the same
            distribution, comparisons between candidates less variance, and most of the random
            numbers need not be drawn.
        precision: of the hidden layers, see :class:`PlanningNetwork`.
        block: trajectories that go through the horizon together; ``None`` fits a processor's
            cache, or takes them all on other devices.
        generator: source of randomness; torch's global one if ``None``.

    Returns:
        returns ``(N, C)``, float32.

    Raises:
        ValueError: for shapes that do not fit the model, unknown propagation, or a reward or
            termination of the wrong shape.

    Examples:
        >>> model = EnsembleDynamics(3, 1, members=5, hidden=(8,))
        >>> evaluate(
        ...     model,
        ...     torch.zeros(2, 3),
        ...     torch.zeros(2, 7, 4, 1),
        ...     reward=lambda x, u, successor: -successor.square().sum(-1),
        ...     particles=12,
        ... ).shape
        torch.Size([2, 7])
    """
    check_sampling(particles, propagation, precision, block)
    if not isinstance(dynamics, PlanningNetwork):
        dynamics = PlanningNetwork.from_dynamics(dynamics, precision)
    network = dynamics
    _check_shapes(network, observation, actions)
    count, horizon = actions.shape[0] * actions.shape[1], actions.shape[2]
    sequences = actions.float().reshape(count, horizon, network.action_dim)
    start = observation.float()
    total = torch.zeros(count, device=sequences.device)
    if block is None:
        block = _CPU_BLOCK if sequences.device.type == "cpu" else _OTHER_BLOCK
    shares = _shares(network, particles, propagation)
    rows = network.members if propagation == "mean" else sum(shares)
    common = None
    if common_noise and propagation != "mean":
        common = _scenarios(network, particles, horizon, generator, start)
    blocks = ceil(count * rows / block)
    size = max(1, ceil(count / blocks))
    for first in range(0, count, size):
        plans = sequences[first : first + size]
        own = torch.arange(plans.shape[0], device=plans.device)
        # Sorted by member, then by candidate.
        plan = torch.cat([own.repeat_interleave(share) for share in shares])
        x = start[(first + plan) // actions.shape[1]]
        u = plans.permute(1, 2, 0)[..., plan].transpose(1, 2)
        draws = _Draws(network, shares, plan.shape[0], horizon, common, generator)
        predict = _predictor(network, propagation, shares, plan, draws)
        returns = _rollout(network, predict, x, u, reward, terminated)
        total[first : first + size].index_add_(0, plan, returns)
    mean = total / sum(shares)
    return torch.where(torch.isfinite(mean), mean, -torch.inf).reshape(actions.shape[:2])


@dataclass(frozen=True)
class TrajectorySampler:
    """The settings of :func:`evaluate` around a model, for planners.

    The model is referred to: every plan copies its weights as they are then.

    Attributes:
        dynamics: the model.
        reward: see :func:`evaluate`, as for all that follow.
        terminated: the task's termination.
        particles: trajectories per candidate.
        propagation: ``"ts1"``, ``"tsinf"`` or ``"mean"``.
        common_noise: here on by default.
        precision: ``"auto"``, ``"float32"`` or ``"bfloat16"``.
        block: trajectories that go through the horizon together.

    Raises:
        ValueError: for an unknown propagation or precision, or no particles.
    """

    dynamics: EnsembleDynamics
    reward: RewardFunction
    terminated: Termination | None = None
    particles: int = 20
    propagation: Propagation = "tsinf"
    precision: Precision = "auto"
    common_noise: bool = True
    block: int | None = None

    def __post_init__(self) -> None:
        """Refuse settings that could only fail later."""
        check_sampling(self.particles, self.propagation, self.precision, self.block)

    def evaluator(self, observation: Tensor, generator: torch.Generator | None = None) -> Evaluate:
        """Returns ``(N, C)`` of sequences ``(N, C, H, m)`` from observations ``(N, n)``."""
        network = PlanningNetwork.from_dynamics(self.dynamics, self.precision)

        def returns(actions: Tensor) -> Tensor:
            return evaluate(
                network,
                observation,
                actions,
                self.reward,
                particles=self.particles,
                propagation=self.propagation,
                terminated=self.terminated,
                common_noise=self.common_noise,
                block=self.block,
                generator=generator,
            )

        return returns


def check_sampling(
    particles: int, propagation: str, precision: str = "float32", block: int | None = None
) -> None:
    """Refuse settings of :func:`evaluate` that make no sense.

    Raises:
        ValueError: naming the setting.
    """
    resolve_precision(precision)
    if propagation not in get_args(Propagation):
        raise ValueError(f"propagation must be one of {get_args(Propagation)}, got {propagation!r}")
    if particles < 1 or (block is not None and block < 1):
        raise ValueError(f"particles and block must be positive, got {particles} and {block}")


def _check_shapes(network: PlanningNetwork, observation: Tensor, actions: Tensor) -> None:
    n, m = network.observation_dim, network.action_dim
    if observation.dim() != 2 or observation.shape[1] != n:
        raise ValueError(
            f"observation must have shape (environments, {n}) for this model, got "
            f"{tuple(observation.shape)}"
        )
    expected = f"({observation.shape[0]}, candidates, horizon, {m})"
    if actions.dim() != 4 or actions.shape[0] != observation.shape[0] or actions.shape[3] != m:
        raise ValueError(
            f"actions must have shape {expected} for this model and observation, got "
            f"{tuple(actions.shape)}"
        )
    if 0 in actions.shape:
        raise ValueError(f"there is nothing to evaluate in actions of shape {tuple(actions.shape)}")


def _shares(network: PlanningNetwork, particles: int, propagation: Propagation) -> list[int]:
    """Particles of each member; of no member in particular unless it is kept."""
    if propagation == "tsinf":
        return [len(range(member, particles, network.members)) for member in range(network.members)]
    return [1 if propagation == "mean" else particles]


_Scenarios = tuple[Tensor, Tensor]


def _scenarios(
    network: PlanningNetwork,
    particles: int,
    horizon: int,
    generator: torch.Generator | None,
    like: Tensor,
) -> _Scenarios:
    """What the particles of all candidates draw: members ``(H, P)`` and noise ``(H, n, P)``."""
    size, device = (horizon, network.observation_dim, particles), like.device
    members = torch.randint(
        network.members, (horizon, particles), generator=generator, device=device
    )
    return members, torch.randn(size, generator=generator, device=device)


class _Draws:
    """Random numbers of B trajectories, sorted by member, candidate and particle."""

    def __init__(
        self,
        network: PlanningNetwork,
        shares: list[int],
        count: int,
        horizon: int,
        common: _Scenarios | None,
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
        """A member for every step and trajectory ``(H, B)``."""
        if self._common is not None:
            return self._common[0][:, self._particle]
        return torch.randint(
            self._network.members,
            (self._horizon, self._count),
            generator=self._generator,
            device=self.device,
        )

    def noise(self, step: int, order: Tensor | None = None) -> Tensor | None:
        """Standard normal numbers ``(B, n)`` of a step, column by column in memory.

        ``order`` says which trajectories they are for; ``None`` if none are needed.
        """
        if self._network.standard_deviation is None:
            return None
        if self._common is not None:
            particle = self._particle if order is None else self._particle[order]
            return self._common[1][step].index_select(1, particle).t()
        size = (self._network.observation_dim, self._count)
        return torch.randn(size, generator=self._generator, device=self.device).t()


def _predictor(
    network: PlanningNetwork,
    propagation: Propagation,
    shares: list[int],
    plan: Tensor,
    draws: _Draws,
) -> _Predict:
    """Normalised change ``(B, n)`` from raw inputs ``(B, n + m)`` at a step."""
    k, count = network.members, plan.shape[0]
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
        # Rows of the same member next to each other, for as long as the products take.
        raw = ForwardPass(network, sizes[step], memory=memory)(inputs[order[step]])
        result = torch.empty_like(inputs[:, : network.observation_dim])
        result[order[step]] = network.sample(raw, draws.noise(step, order[step]))
        return result

    return switching


def _rollout(
    network: PlanningNetwork,
    predict: _Predict,
    x: Tensor,
    u: Tensor,
    reward: RewardFunction,
    terminated: Termination | None,
) -> Tensor:
    """Returns ``(B,)`` of trajectories from ``(B, n)`` under actions ``(H, B, m)``."""
    horizon, n = u.shape[0], x.shape[1]
    # Column by column in memory: all that is done to a state is then done to whole columns.
    inputs = x.new_empty(horizon + 1, n + u.shape[2], x.shape[0]).transpose(1, 2)
    states = inputs[..., :n]
    states[0] = x
    inputs[:-1, :, n:] = u
    for t in range(horizon):
        change = predict(inputs[t], t)
        torch.addcmul(states[t], change, network.change_std, out=states[t + 1])
        states[t + 1] += network.change_mean
    rewards = _along(reward(states[:-1], u, states[1:]), u, "reward")
    if terminated is None:
        # A state that is not finite stays so: the last tells for all.
        sound = torch.isfinite(states[-1]).all(-1)
    else:
        ended = _along(terminated(states[1:]), u, "terminated").long()
        over = (ended.cumsum(0) - ended) > 0
        rewards = torch.where(over, 0.0, rewards)
        sound = (torch.isfinite(states[1:]).all(-1) | over).all(0)
    returns = rewards.sum(0)
    return torch.where(sound & torch.isfinite(returns), returns, -torch.inf)


def _along(values: Tensor, u: Tensor, name: str) -> Tensor:
    if values.shape != u.shape[:2]:
        raise ValueError(
            f"the {name} function must return shape (...) for inputs of shape (..., width), got "
            f"{tuple(values.shape)} for inputs of shape {tuple(u.shape[:2])} + (width,)"
        )
    return values
