"""Trajectory sampling: returns of action sequences, by particles through an ensemble."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import get_args

import torch
from torch import Tensor

from torchrl_l1.checks import check_choice, check_count, check_optional_count, check_within
from torchrl_l1.compilation import CompileMode
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.dynamics.functions import RewardFunction, Termination
from torchrl_l1.dynamics.network import (
    PlanningNetwork,
    Precision,
    model_precision,
    resolve_precision,
)
from torchrl_l1.planning.compiled_motion import compiled_predictor, resolve_compilation
from torchrl_l1.planning.particles import (
    Draws,
    Propagation,
    imagined_returns,
    member_shares,
    predictor,
    scenarios,
)
from torchrl_l1.planning.sequences import Evaluate

# Trajectories that pass through the horizon together: enough to make the cost of a call negligible,
# and no more than a CPU's caches hold. On other devices it only bounds the memory.
_CPU_BLOCK = 8000
_OTHER_BLOCK = 131_072


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
    discount: float = 1.0,
    compile: CompileMode = False,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Mean over particles of the discounted sum of imagined rewards.

    How a particle travels (arXiv 1805.12114, section 5):

    - ``"tsinf"``: particle :math:`p` keeps elite :math:`p \bmod k` for the whole horizon; any
      number of particles is allowed, but fewer than k leave elites out;
    - ``"ts1"``: every particle draws an elite at every step;
    - ``"mean"``: one particle, whatever ``particles`` is, moved by the mean of the elites' mean
      changes.

    With ``"tsinf"`` and ``"ts1"`` the change is sampled from the member's distribution if its head
    has one. A particle earns the reward of the step that terminates it, and nothing after it. If
    rewards are negative, shift them, or ending early pays. A particle whose state or reward is not
    finite before it terminates makes the return of its candidate minus infinity.

    Args:
        dynamics: the model, or a snapshot of it, which is used as it is.
        observation: observations of the N environments ``(N, n)``.
        actions: candidate sequences ``(N, C, H, m)``; they are not clipped.
        reward: maps observations ``(..., n)``, actions ``(..., m)`` and next observations to
            ``(...)``; it sees whole trajectories at once.
        particles: trajectories per candidate, P.
        propagation: see above.
        terminated: maps next observations ``(..., n)`` to booleans ``(...)``; never if ``None``.
        common_noise: whether particle p of every candidate meets the same draws of members and
            noise (common random numbers, arXiv 1301.3878) instead of its own. Each return keeps its
            distribution, comparisons between candidates have less variance, and most of the random
            numbers need not be drawn.
        precision: precision of the hidden layers, see :class:`PlanningNetwork`.
        block: number of trajectories that pass through the horizon together; if ``None``, as many
            as fit a CPU's cache, or 131 072 on other devices.
        discount: the reward of step :math:`t = 0, 1, \ldots` counts ``discount**t`` times.
        compile: whether to compile the motion of the particles, see
            :func:`~torchrl_l1.planning.resolve_compilation`. Eager and compiled returns are
            equal up to rounding.
        generator: source of randomness; torch's global one if ``None``.

    Returns:
        returns ``(N, C)``, float32.

    Raises:
        ValueError: for shapes that do not fit the model, an unknown propagation, a discount outside
            (0, 1], ``"ts1"`` compiled, a reward or termination of the wrong shape, or one that
            writes to its inputs.

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
    check_sampling(particles, propagation, precision, block, discount, compile)
    if not isinstance(dynamics, PlanningNetwork):
        dynamics = PlanningNetwork.from_dynamics(dynamics, precision)
    network = dynamics
    _check_shapes(network, observation, actions)
    count, horizon = actions.shape[0] * actions.shape[1], actions.shape[2]
    sequences = actions.float().reshape(count, horizon, network.action_dim)
    start = observation.float()
    total = sequences.new_zeros(count)
    if block is None:
        block = _CPU_BLOCK if sequences.device.type == "cpu" else _OTHER_BLOCK
    each = member_shares(network, particles, propagation)
    rows = network.members if propagation == "mean" else sum(each)
    fused = resolve_compilation(compile, sequences.device, propagation)
    common = None
    if common_noise and propagation != "mean":
        common = scenarios(network, particles, horizon, generator, start)
    blocks = ceil(count * rows / block)
    size = max(1, ceil(count / blocks))
    for first in range(0, count, size):
        plans = sequences[first : first + size]
        own = torch.arange(plans.shape[0], device=plans.device)
        # Sorted by member, then by candidate.
        plan = torch.cat([own.repeat_interleave(share) for share in each])
        x = start[(first + plan) // actions.shape[1]]
        u = plans.permute(1, 2, 0)[..., plan].transpose(1, 2)
        draws = Draws(network, each, plan.shape[0], horizon, common, generator)
        if fused:
            predict = compiled_predictor(network, propagation, each, draws, compile)
        else:
            predict = predictor(network, propagation, each, plan.shape[0], draws)
        returns = imagined_returns(network, predict, x, u, reward, terminated, discount)
        total[first : first + size].index_add_(0, plan, returns)
    mean = total / sum(each)
    return torch.where(torch.isfinite(mean), mean, -torch.inf).reshape(actions.shape[:2])


@dataclass(frozen=True)
class TrajectorySampler:
    """The settings of :func:`evaluate` for a model, for use by planners.

    The model is referenced: every plan copies its current weights.

    Attributes:
        dynamics: the model.
        reward: see :func:`evaluate`, also for all that follow.
        terminated: the task's termination.
        particles: trajectories per candidate.
        propagation: ``"ts1"``, ``"tsinf"`` or ``"mean"``.
        common_noise: on by default here.
        precision: ``"auto"``, ``"float32"`` or ``"bfloat16"``.
        block: number of trajectories that pass through the horizon together.
        discount: factor on the rewards per step.
        compile: ``True``, ``False``, or ``"auto"`` for the faster one.

    Raises:
        ValueError: for an unknown propagation, precision or mode of compilation, no particles, a
            discount outside (0, 1], or ``"ts1"`` compiled.
    """

    dynamics: EnsembleDynamics
    reward: RewardFunction
    terminated: Termination | None = None
    particles: int = 20
    propagation: Propagation = "tsinf"
    precision: Precision = "auto"
    common_noise: bool = True
    block: int | None = None
    discount: float = 1.0
    compile: CompileMode = False

    def __post_init__(self) -> None:
        check_sampling(
            self.particles,
            self.propagation,
            self.precision,
            self.block,
            self.discount,
            self.compile,
        )

    def choices(self) -> dict[str, str]:
        """What ``"auto"`` has become: the precision, and compiled or eager plans.

        Whether compilation succeeds is known only after the first plan.
        """
        plans = "eager"
        if resolve_compilation(self.compile, self.dynamics.device, self.propagation):
            plans = "compiled"
            if self.compile == "auto":
                plans += ", or eager if compiling fails"
        return {"precision": model_precision(self.dynamics, self.precision), "plans": plans}

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
                discount=self.discount,
                compile=self.compile,
                generator=generator,
            )

        return returns


def check_sampling(
    particles: int,
    propagation: str,
    precision: str = "float32",
    block: int | None = None,
    discount: float = 1.0,
    compile: bool | str = False,
) -> None:
    """Reject settings of :func:`evaluate` that make no sense.

    Raises:
        ValueError: naming the setting.
    """
    resolve_precision(precision)
    check_choice("propagation", propagation, get_args(Propagation))
    check_count("particles", particles)
    check_optional_count("block", block)
    check_within("discount", discount, "(0, 1]")
    resolve_compilation(compile, propagation=propagation)


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
