"""Gaussian policies as TorchRL actors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    TensorDictModule,
    TensorDictModuleBase,
    dispatch,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_l1.algorithms.facts import KINDS
from torchrl_l1.checks import check_positive
from torchrl_l1.dynamics import Normalizer
from torchrl_l1.envs import AnyTask, action_bounds
from torchrl_l1.objectives import is_tanh_network

# Statistics are folded into weights if an entry's mean is this many standard deviations from zero
# at most.
_MOST_OFFSET = 1e4

_MEAN = (ExplorationType.DETERMINISTIC, ExplorationType.MEAN, ExplorationType.MODE)


class GaussianPolicy(nn.Module):
    """Tanh network for the mean, with a free parameter for the log standard deviation.

    Observations first pass a normaliser, which is the identity until it is fitted.

    Args:
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        hidden: widths of the hidden layers.
        std: initial standard deviation, in action units.
    """

    def __init__(
        self, observation_dim: int, action_dim: int, hidden: Sequence[int], std: float = 1.0
    ) -> None:
        super().__init__()
        self.normalizer = Normalizer(observation_dim, std_floor=1e-2)
        layers: list[nn.Module] = []
        widths = [observation_dim, *hidden]
        for fan_in, fan_out in pairwise(widths):
            layers += [_normalized_linear(fan_in, fan_out, 1.0), nn.Tanh()]
        # The last layer is small: the first policy is close to zero-mean noise.
        layers.append(_normalized_linear(widths[-1], action_dim, 0.01))
        self.mean = nn.Sequential(*layers)
        self.log_std = nn.Parameter(torch.zeros(action_dim))
        self.reset_std(std)

    @torch.no_grad()
    def reset_std(self, std: float) -> None:
        """Set the standard deviation of every action entry."""
        check_positive("the policy's standard deviation", std)
        self.log_std.fill_(torch.tensor(std).log())

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation ``(..., m)`` for observations ``(..., n)``."""
        loc = self.mean(self.normalizer.normalize(observation))
        return loc, self.log_std.exp().expand_as(loc)

    def sample(self, observation: Tensor) -> Tensor:
        """One action per observation: ``(..., n)`` to ``(..., m)``."""
        loc, scale = self(observation)
        return torch.addcmul(loc, scale, torch.randn_like(loc))

    @property
    def is_plain(self) -> bool:
        """Whether it is exactly this class, whose internals faster code may use."""
        return type(self) is GaussianPolicy and is_tanh_network(self.mean)

    @torch.no_grad()
    def sampler(self) -> Callable[[Tensor], Tensor]:
        """A faster :meth:`sample` with the current parameters, for many calls.

        The statistics are folded into the first layer, and nothing is prepared twice. A user's own
        policy keeps its own sampling.
        """
        if not self.is_plain:
            return torch.no_grad()(self.sample)
        # An entry far from zero relative to its spread would lose precision.
        if bool((self.normalizer.mean.abs() > _MOST_OFFSET * self.normalizer.std).any()):
            return torch.no_grad()(deepcopy(self).sample)
        layers = [layer for layer in self.mean if isinstance(layer, nn.Linear)]
        weights = [layer.weight.t().clone() for layer in layers]
        biases = [layer.bias.clone() for layer in layers]
        weights[0] /= self.normalizer.std[:, None]
        biases[0] -= self.normalizer.mean @ weights[0]
        std = self.log_std.exp()

        @torch.no_grad()
        def sample(observation: Tensor) -> Tensor:
            units = torch.addmm(biases[0], observation, weights[0])
            for bias, weight in zip(biases[1:], weights[1:], strict=True):
                units = torch.addmm(bias, units.tanh_(), weight)
            return units.addcmul_(std, torch.randn_like(units))

        return sample


def _normalized_linear(fan_in: int, fan_out: int, norm: float) -> nn.Linear:
    """Linear layer whose rows have the given norm and whose biases are zero."""
    layer = nn.Linear(fan_in, fan_out)
    with torch.no_grad():
        layer.weight.normal_()
        layer.weight.mul_(norm / layer.weight.norm(dim=1, keepdim=True))
        layer.bias.zero_()
    return layer


class GaussianActor(ProbabilisticActor):
    """TorchRL actor around a :class:`GaussianPolicy`, light enough to act at every step.

    A :class:`~torchrl.modules.ProbabilisticActor` in all respects, but its call skips the
    bookkeeping between its two modules, which takes four times as long as everything else. It draws
    the same actions from the same random numbers.

    Args:
        policy: shared, not copied.
        action_key: key of the action.
        log_prob_key: key of the logarithm of the action's density; not written if ``None``.
        bounds: bounds to which the action is clipped; none if ``None``. Distribution and density
            remain those of the action before clipping.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = GaussianActor(GaussianPolicy(3, 1, (8,)), bounds=(-1.0, 1.0))
        >>> data = TensorDict(observation=torch.zeros(5, 3), batch_size=[5])
        >>> sorted(actor(data).keys())
        ['action', 'loc', 'observation', 'scale']
    """

    def __init__(
        self,
        policy: GaussianPolicy,
        action_key: str = "action",
        log_prob_key: str | None = None,
        bounds: tuple[float, float] | tuple[Tensor, Tensor] | None = None,
    ) -> None:
        super().__init__(
            TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            out_keys=[action_key],
            distribution_class=IndependentNormal,
            return_log_prob=log_prob_key is not None,
            log_prob_key=log_prob_key,
        )
        self.action_key = action_key
        self.density_key = log_prob_key
        self.bounds = bounds

    @dispatch(auto_batch_size=False)
    def forward(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        """Write ``loc``, ``scale`` and the action: a draw or the mean, by the exploration type."""
        kind = exploration_type()
        drawn = kind is ExplorationType.RANDOM
        if tensordict_out is not None or kwargs or not (drawn or kind in _MEAN):
            out = super().forward(tensordict, tensordict_out, **kwargs)
            return out.set(self.action_key, self._clipped(out.get(self.action_key)))
        policy: GaussianPolicy = self.module[0].module
        loc, scale = policy(tensordict.get("observation"))
        action = loc
        if drawn:
            # Bit for bit as torch.distributions does.
            action = loc + torch.randn(loc.shape, dtype=loc.dtype, device=loc.device) * scale
        tensordict.set("loc", loc)
        tensordict.set("scale", scale)
        tensordict.set(self.action_key, self._clipped(action))
        if self.density_key is not None:
            tensordict.set(self.density_key, IndependentNormal(loc, scale).log_prob(action))
        return tensordict

    def _clipped(self, action: Tensor) -> Tensor:
        return action if self.bounds is None else action.clamp(*self.bounds)


def make_actor(
    policy: GaussianPolicy, action_key: str = "action", log_prob_key: str | None = None
) -> ProbabilisticActor:
    """TorchRL actor around the policy: ``observation`` to ``loc``, ``scale`` and the action.

    With a ``log_prob_key`` it writes the logarithm of the action's density there.
    """
    return GaussianActor(policy, action_key, log_prob_key)


def acting(policy: GaussianPolicy, task: AnyTask, clip: bool = True) -> TensorDictModuleBase:
    """The actor for the real system: the policy's, with actions clipped to the task's bounds.

    Both arms of a comparison, with and without L1, use and store clipped actions.

    Args:
        policy: shared, not copied.
        task: provides the bounds.
        clip: whether to clip.

    Raises:
        ValueError: if the policy is not float32, as the observations of tasks are.
    """
    kind = policy.log_std.dtype
    if kind != torch.float32:
        raise ValueError(
            f"the policy is {kind}, but tasks give observations of torch.float32: call "
            "torch.set_default_dtype(torch.float32) before it is made"
        )
    low, high = task.action_low, task.action_high
    if not clip:
        return GaussianActor(policy)
    if isinstance(low, tuple) or isinstance(high, tuple):
        return GaussianActor(policy, bounds=action_bounds(task))
    return GaussianActor(policy, bounds=(low, high))


def kinds_of(policy: TensorDictModuleBase) -> tuple[str, ...]:
    """The distinct ways to act: both for a distribution over actions, otherwise ``stochastic``.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> kinds_of(TensorDictModule(lambda x: x, ["observation"], ["action"]))
        ('stochastic',)
    """
    samples = any(isinstance(part, ProbabilisticTensorDictModule) for part in policy.modules())
    return KINDS if samples else KINDS[:1]
