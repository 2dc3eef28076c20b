"""Learned rewards and terminations: small ensembles beside that of the dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_l1.dynamics.ensemble import EnsembleMLP
from torchrl_l1.dynamics.fit import (
    FitConfig,
    FitReport,
    check_decay,
    check_optimizer,
    train_members,
)
from torchrl_l1.dynamics.heads import BernoulliHead, DeterministicHead, Head
from torchrl_l1.dynamics.normalizer import DataBox, Normalizer

# Rows that pass through the network together: their hidden units stay in a CPU's cache.
_CPU_BLOCK = 2048
_OTHER_BLOCK = 262_144

# Validation rows whose losses are computed together.
_CHUNK = 20_000

# Largest factor on an error for the rarer kind of transition in a fit.
_MOST_WEIGHT = 1e3


class OutcomeModel(nn.Module):
    """Perceptrons that map a row of numbers to one number, with a normaliser in front.

    Args:
        in_features: width of a row.
        head: interpretation of the number, and its loss.
        members: number of networks, E.
        hidden: widths of the hidden layers.
        activation: ``"relu"``, ``"tanh"`` or ``"silu"``.
        std_floor: smallest standard deviation of the normalisers, raw units.
    """

    affine_in_action = False

    def __init__(
        self,
        in_features: int,
        head: Head,
        members: int,
        hidden: Sequence[int],
        activation: str,
        std_floor: float,
    ) -> None:
        super().__init__()
        self.head = head
        self.network = EnsembleMLP(in_features, 1, hidden, members, activation)
        self.input_normalizer = Normalizer(in_features, std_floor)

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.input_normalizer.mean.device

    def network_inputs(self, inputs: Tensor) -> Tensor:
        """The part of the normalised rows that the network reads: all of it."""
        return inputs

    def raw_from_output(self, output: Tensor, inputs: Tensor) -> Tensor:
        """The head's input, from the network's output: the same."""
        return output

    def member_mean(self, rows: Tensor) -> Tensor:
        """Mean of the members' raw outputs: ``(..., in)`` to ``(...)``, normalised units."""
        flat = rows.reshape(-1, rows.shape[-1])
        block = _CPU_BLOCK if flat.device.type == "cpu" else _OTHER_BLOCK
        parts = [
            self.network(self.input_normalizer.normalize(part)).mean(0)
            for part in flat.split(block)
        ]
        return torch.cat(parts).reshape(rows.shape[:-1])


class RewardModel(OutcomeModel):
    """A learned reward of observation, action and next observation.

    The networks see the observation, the action and the change of the observation, each entry
    normalised on its own. The reward is the mean over the members, limited to the range of the
    data's rewards widened by ``margin``: outside, a regression knows nothing, and a policy would
    exploit its errors.

    Args:
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        members: number of networks.
        hidden: widths of the hidden layers.
        activation: ``"relu"``, ``"tanh"`` or ``"silu"``.
        std_floor: smallest standard deviation of the normalisers, raw units.
        margin: how far a reward may exceed the range of the data's, as a fraction of that range.

    Examples:
        >>> model = RewardModel(3, 1, hidden=(16,))
        >>> x, u = torch.zeros(7, 5, 3), torch.zeros(7, 5, 1)
        >>> model(x, u, x).shape
        torch.Size([7, 5])
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        members: int = 3,
        hidden: Sequence[int] = (128, 128),
        activation: str = "silu",
        std_floor: float = 1e-4,
        margin: float = 0.5,
    ) -> None:
        width, head = 2 * observation_dim + action_dim, DeterministicHead()
        super().__init__(width, head, members, hidden, activation, std_floor)
        self.reward_normalizer = Normalizer(1, std_floor)
        self.box = DataBox(1, margin)

    @staticmethod
    def rows(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
        """The model's input from transitions ``(..., n)``, ``(..., m)`` and ``(..., n)``."""
        return torch.cat([observation, action, next_observation - observation], -1)

    def forward(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
        """Rewards of transitions ``(..., n)``, ``(..., m)`` and ``(..., n)``: ``(...)``."""
        mean = self.member_mean(self.rows(observation, action, next_observation))
        reward = self.reward_normalizer.denormalize(mean.unsqueeze(-1))
        return torch.clamp(reward, self.box.low, self.box.high).squeeze(-1)


class TerminationModel(OutcomeModel):
    """A learned termination: whether an episode is over in a next observation.

    Terminal states are rare, so a fit gives errors on them proportionally more weight. Then the
    threshold is set so that as many of the training data's states lie above it as are terminal:
    imagination then ends episodes as often as the data do, however sharp the networks are by then.
    If no terminal state has been seen, none is predicted.

    Args:
        observation_dim: number of observations, n.
        members: number of networks.
        hidden: widths of the hidden layers.
        activation: ``"relu"``, ``"tanh"`` or ``"silu"``.
        std_floor: smallest standard deviation of the normaliser, raw units.

    Attributes:
        threshold: log-odds above which a state is terminal, ``()``; infinite until one is seen.

    Examples:
        >>> model = TerminationModel(3, hidden=(16,))
        >>> model(torch.zeros(7, 5, 3)).any()
        tensor(False)
    """

    threshold: Tensor
    head: BernoulliHead

    def __init__(
        self,
        observation_dim: int,
        members: int = 3,
        hidden: Sequence[int] = (128, 128),
        activation: str = "silu",
        std_floor: float = 1e-4,
    ) -> None:
        head = BernoulliHead()
        super().__init__(observation_dim, head, members, hidden, activation, std_floor)
        self.register_buffer("threshold", torch.full((), torch.inf))

    def forward(self, next_observation: Tensor) -> Tensor:
        """Whether episodes end in next observations ``(..., n)``: ``(...)``, bool."""
        return self.member_mean(next_observation) > self.threshold


@dataclass
class RewardReport:
    """Outcome of a fit of a :class:`RewardModel`.

    Attributes:
        fit: losses and steps, normalised units.
        explained_variance: share of the variance of the validation data's rewards that the model
            explains: one minus the mean squared error divided by that variance.
    """

    fit: FitReport
    explained_variance: float


@dataclass
class TerminationReport:
    """Outcome of a fit of a :class:`TerminationModel`.

    Attributes:
        fit: losses, with the rarer kind weighted, and steps; zeros if there is nothing to learn.
        terminal: share of the training transitions that end an episode.
        missed: share of the validation data's terminal states that the model fails to predict; zero
            if there are none.
        false_alarms: share of the other states that the model predicts to be terminal.
    """

    fit: FitReport
    terminal: float
    missed: float
    false_alarms: float


def fit_reward(
    model: RewardModel,
    train: TensorDictBase,
    validation: TensorDictBase,
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
    action_key: NestedKey = "action",
) -> RewardReport:
    """Fit a model to the rewards of transitions, starting from its current weights.

    Args:
        model: the model, changed in place.
        train: transitions ``[N]`` with ``observation``, an action, ``("next", "observation")`` and
            ``("next", "reward")``.
        validation: other transitions, which decide when to stop.
        config: as for the dynamics; shares of the data and elites are not used.
        optimizer: over the model's parameters.
        action_key: key of the action that earned the reward.

    Raises:
        ValueError: if there is nothing to train or to validate on, for decay of other layers, or an
            optimizer of another model. The model is then unchanged.

    Examples:
        >>> from tensordict import TensorDict
        >>> x, u = torch.randn(300, 2), torch.randn(300, 1)
        >>> data = TensorDict({"observation": x, "action": u}, batch_size=[300])
        >>> data["next"] = {"observation": x + u, "reward": u.square()}
        >>> model = RewardModel(2, 1, hidden=(16,))
        >>> optimizer = torch.optim.Adam(model.parameters())
        >>> fit_reward(model, data[:200], data[200:], FitConfig(), optimizer).fit.epochs > 0
        True
    """
    _check(model, train, validation, config, optimizer)
    rows = [_transitions(model, part, action_key) for part in (train, validation)]
    rewards = [_column(model, part, "reward") for part in (train, validation)]
    normalizer = model.reward_normalizer
    normalizer.fit(rewards[0])
    model.box.fit(rewards[0])
    targets = [normalizer.normalize(part) for part in rewards]
    fit = _fit(model, rows, targets, config, optimizer)
    with torch.no_grad():
        error = normalizer.denormalize(model.member_mean(rows[1])[:, None]) - rewards[1]
    # Constant rewards have no variance to explain.
    floor = normalizer.std_floor**2
    spread = max(rewards[1].var(correction=0).item(), floor)
    return RewardReport(fit, 1 - error.square().mean().item() / spread)


def fit_termination(
    model: TerminationModel,
    train: TensorDictBase,
    validation: TensorDictBase,
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
) -> TerminationReport:
    """Fit a model to the terminations of episodes, starting from its current weights.

    An end by the clock, ``truncated``, is not a property of the state and must not count as a
    termination.

    Args:
        model: the model, changed in place; if no transition of ``train`` ends an episode, it only
            learns to predict no end.
        train: transitions ``[N]`` with ``("next", "observation")`` and ``("next", "terminated")``.
        validation: other transitions, which decide when to stop.
        config: as for the dynamics; shares of the data and elites are not used.
        optimizer: over the model's parameters.

    Raises:
        ValueError: as :func:`fit_reward`.
    """
    _check(model, train, validation, config, optimizer)
    rows = [_column(model, part, "observation") for part in (train, validation)]
    ends = [_column(model, part, "terminated") for part in (train, validation)]
    share = ends[0].mean().item()
    model.threshold.fill_(torch.inf)
    fit = FitReport(0.0, 0.0, 0, 0)
    if share > 0:
        weight = (1 - share) / share
        model.head.weight.fill_(min(max(weight, 1 / _MOST_WEIGHT), _MOST_WEIGHT))
        fit = _fit(model, rows, ends, config, optimizer)
        with torch.no_grad():
            model.threshold.copy_(_threshold(model.member_mean(rows[0]), int(ends[0].sum())))
    with torch.no_grad():
        called, ended = model(rows[1]), ends[1][:, 0] > 0
    missed, alarms = (~called)[ended], called[~ended]
    return TerminationReport(
        fit,
        terminal=share,
        missed=missed.float().mean().item() if len(missed) else 0.0,
        false_alarms=alarms.float().mean().item() if len(alarms) else 0.0,
    )


def _check(
    model: OutcomeModel,
    train: TensorDictBase,
    validation: TensorDictBase,
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
) -> None:
    """Reject data to which no model can be fitted."""
    counts = train.shape[0], validation.shape[0]
    if 0 in counts:
        raise ValueError(
            f"cannot fit a {type(model).__name__}: {counts[0]} training and {counts[1]} validation "
            "transitions; collect more data or keep others out of training"
        )
    check_decay(config, model)
    check_optimizer(optimizer, model)


def _fit(
    model: OutcomeModel,
    rows: Sequence[Tensor],
    targets: Sequence[Tensor],
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
) -> FitReport:
    """Fit the networks to the first rows and targets, and validate them on the second."""
    model.input_normalizer.fit(rows[0])
    model.input_normalizer.ignore((rows[0] == rows[0][:1]).all(0))
    inputs, held_out = map(model.input_normalizer.normalize, rows)

    @torch.no_grad()
    def validate() -> Tensor:
        parts = zip(held_out.split(_CHUNK), targets[1].split(_CHUNK), strict=True)
        losses = [model.head.loss(model.network(part), wanted) for part, wanted in parts]
        return torch.cat(losses, -1).mean(-1)

    return train_members(model, inputs, targets[0], validate, config, optimizer)[1]


def _threshold(values: Tensor, count: int) -> Tensor:
    """The value that this many of the values exceed: midway between two of them."""
    padded = torch.cat([values.sort(descending=True).values, values.new_full((1,), -torch.inf)])
    return padded[count - 1 : count + 1].mean()


def _transitions(model: RewardModel, data: TensorDictBase, action_key: NestedKey) -> Tensor:
    """A reward model's input from transitions, on its device."""
    parts = (data["observation"], data[action_key], data["next", "observation"])
    return model.rows(*(part.to(model.device) for part in parts))


def _column(model: OutcomeModel, data: TensorDictBase, name: str) -> Tensor:
    """The next observations of transitions ``(N, width)``, with the model's device and dtype."""
    return data["next", name].to(model.input_normalizer.mean).reshape(data.shape[0], -1)
