"""Rewards and terminations of imagined trajectories: from the task, functions, or models."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ReplayBuffer

from torchrl_l1.algorithms.collection import seed_streams
from torchrl_l1.checks import check_choice, check_counts, check_widths
from torchrl_l1.dynamics import (
    FitConfig,
    RewardModel,
    TerminationModel,
    fit_reward,
    fit_termination,
)
from torchrl_l1.dynamics.ensemble import ACTIVATIONS
from torchrl_l1.dynamics.functions import RewardFunction, Termination
from torchrl_l1.dynamics.transitions import split_validation
from torchrl_l1.envs import AnyTask, ExternalTask, StartStates, Task, action_bounds, load_attribute

REWARDS = ("builtin", "learned")
"""Keywords of ``reward``; anything else is a function."""

TERMINATIONS = ("builtin", "learned", "none")
"""Keywords of ``termination``; anything else is a function."""

OUTCOME_METRICS: dict[str, str] = {
    "reward_model/validation_loss": "With `reward=learned`: mean over members of the lowest "
    "validation loss of the reward, normalised units.",
    "reward_model/explained_variance": "With `reward=learned`: share of the variance of the "
    "validation data's rewards that the model explains.",
    "termination_model/validation_loss": "With `termination=learned`: mean over members of the "
    "lowest validation loss, nats, terminal states weighted; 0 before one is seen.",
    "termination_model/terminal": "With `termination=learned`: share of the training transitions "
    "that ended an episode.",
    "termination_model/missed": "With `termination=learned`: share of the terminal states held out "
    "of training that the model does not call terminal; 0 if there are none.",
    "termination_model/false_alarms": "With `termination=learned`: share of the other states held "
    "out of training that it calls terminal.",
}
"""Metrics of the fits of learned rewards and terminations."""


@dataclass
class OutcomeConfig:
    """The separate ensembles of a learned reward and a learned termination.

    They are fitted like the dynamics, but without decay, resampling and elites.

    Attributes:
        members: number of networks, whose mean is used.
        hidden: widths of their hidden layers.
        activation: ``relu``, ``tanh`` or ``silu``.
    """

    members: int = 3
    hidden: list[int] = field(default_factory=lambda: [128, 128])
    activation: str = "silu"

    def __post_init__(self) -> None:
        check_counts(self, "members", prefix="outcome_model.")
        check_widths("outcome_model.hidden", self.hidden)
        check_choice("outcome_model.activation", self.activation, tuple(ACTIVATIONS))


def check_outcome(name: str, value: str) -> None:
    """Refuse, with a ``ValueError``, what is neither a keyword nor the form of a function.

    Args:
        name: ``reward`` or ``termination``.
        value: its value.

    Examples:
        >>> check_outcome("reward", "me")
        Traceback (most recent call last):
            ...
        ValueError: reward must be builtin, learned, MODULE:FUNCTION or FILE.py:FUNCTION, got 'me'
    """
    words = REWARDS if name == "reward" else TERMINATIONS
    module, colon, function = value.partition(":")
    if value not in words and not (module and colon and function.isidentifier()):
        raise ValueError(
            f"{name} must be {', '.join(words)}, MODULE:FUNCTION or FILE.py:FUNCTION, got {value!r}"
        )


class Outcomes:
    """Rewards and terminations of imagined transitions.

    Models of either are fitted after the dynamics, to the same data. They have their own random
    streams: no other random numbers of a run depend on them.

    Args:
        task: the task, which provides the built-in reward and termination.
        reward: ``builtin``, ``learned``, or a function ``MODULE:FUNCTION`` of observation, action
            and next observation, in batched torch.
        termination: ``builtin``, ``learned``, ``none``, or a function of the next observation.
        config: settings of the models.
        fit: how the dynamics are fitted.
        std_floor: smallest standard deviation of the normalisers, in raw units.
        margin: how far a learned reward may exceed those of the data, as a fraction of their range.
        seed: seed of the run.
        device: device of the models.
        search_path: folders for files and modules that are named.

    Attributes:
        own_termination: whether imagined trajectories end as the task does.
        reward: maps observations ``(..., n)``, actions ``(..., m)`` and next observations to
            ``(...)``.
        models: the learned models by name.

    Raises:
        ValueError: if there is no such function, or it returns something unsuitable.
    """

    def __init__(
        self,
        task: AnyTask,
        reward: str = "builtin",
        termination: str = "builtin",
        config: OutcomeConfig | None = None,
        fit: FitConfig | None = None,
        *,
        std_floor: float = 1e-4,
        margin: float = 0.5,
        seed: int = 0,
        device: torch.device | str = "cpu",
        search_path: Sequence[str] = (),
    ) -> None:
        check_outcome("reward", reward)
        check_outcome("termination", termination)
        # Their own values: decay is set per layer of the dynamics, elites per member.
        alone: dict[str, Any] = {
            "weight_decay": [],
            "weight_penalty": 0.0,
            "bootstrap": False,
            "elites": None,
        }
        self.fit_config = replace(fit or FitConfig(), **alone)
        self.task, self.seed, self.device = task, seed, torch.device(device)
        self.models: dict[str, RewardModel | TerminationModel] = {}
        n, m = task.observation_dim, task.action_dim
        networks = vars(config or OutcomeConfig())
        self.reward: RewardFunction
        self._termination: Termination | None = None
        self.own_termination = termination == "builtin"
        with self._stream("initialisation"):
            if reward == "learned":
                model = RewardModel(n, m, **networks, std_floor=std_floor, margin=margin)
                self.reward = self.models["reward_model"] = model.to(self.device)
            elif reward == "builtin":
                self.reward = task.imagined_reward
            else:
                found = _transitions(task, self.device)
                self.reward = _function("reward", reward, found, search_path)
            if self.own_termination:
                _ = task.terminates  # an external environment may not tell
            if termination == "learned":
                ends = TerminationModel(n, **networks, std_floor=std_floor).to(self.device)
                self._termination = self.models["termination_model"] = ends
            elif termination not in TERMINATIONS:
                states = _transitions(task, self.device)[2:]
                self._termination = _function("termination", termination, states, search_path)
        self.optimizers = {
            name: torch.optim.Adam(model.parameters(), lr=self.fit_config.learning_rate, fused=True)
            for name, model in self.models.items()
        }

    @property
    def learns_terminations(self) -> bool:
        """Whether data must tell where episodes terminated."""
        return "termination_model" in self.models

    def termination(self, as_task: bool = True) -> Termination | None:
        """The function that ends imagined trajectories; ``None`` if they do not end.

        Args:
            as_task: whether they end as the task does if ``termination`` is ``builtin``.
        """
        if not self.own_termination:
            return self._termination
        return self.task.terminated if as_task and self.task.terminates else None

    def fit(self, buffer: ReplayBuffer, action_key: str, iteration: int) -> dict[str, float]:
        """Fit the learned models to all data, from their current weights; returns their metrics.

        Args:
            buffer: transitions with the flag ``validation``.
            action_key: key of the action that the dynamics are fitted to.
            iteration: the outer iteration, for the random numbers.
        """
        if not self.models:
            return {}
        keys = ("observation", action_key, ("next", "observation"), ("next", "reward"))
        setting = "fit.validation_fraction"
        train, validation = (
            part[_finite(part, *keys)]
            for part in split_validation(buffer, "fit rewards", "transitions", setting)
        )
        metrics: dict[str, float] = {}
        with self._stream("iteration", iteration):
            for name, model in self.models.items():
                arguments = (train, validation, self.fit_config, self.optimizers[name])
                if isinstance(model, RewardModel):
                    learned = fit_reward(model, *arguments, action_key)
                    metrics |= {
                        f"{name}/validation_loss": learned.fit.validation_loss,
                        f"{name}/explained_variance": learned.explained_variance,
                    }
                else:
                    ends = fit_termination(model, *arguments)
                    metrics |= {
                        f"{name}/validation_loss": ends.fit.validation_loss,
                        f"{name}/terminal": ends.terminal,
                        f"{name}/missed": ends.missed,
                        f"{name}/false_alarms": ends.false_alarms,
                    }
        return metrics

    @contextmanager
    def _stream(self, *names: str | int) -> Iterator[None]:
        """Separate random numbers, which leave the global generator untouched."""
        on_cpu = self.device.type == "cpu"
        with torch.random.fork_rng(devices=[] if on_cpu else [self.device]):
            seed_streams(self.seed, "outcomes", *names)
            yield

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dicts of the models by name."""
        return {name: model.state_dict() for name, model in self.models.items()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue; empty if nothing is learned."""
        return {
            name: {"model": model.state_dict(), "optimizer": self.optimizers[name].state_dict()}
            for name, model in self.models.items()
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        for name, model in self.models.items():
            model.load_state_dict(state[name]["model"])
            self.optimizers[name].load_state_dict(state[name]["optimizer"])


def _finite(data: TensorDictBase, *keys: NestedKey) -> Tensor:
    """Rows of ``[N]`` that are finite under all keys: ``(N,)``."""
    return torch.stack([data[key].isfinite().flatten(1).all(1) for key in keys]).all(0)


def _transitions(task: AnyTask, device: torch.device) -> list[Tensor]:
    """Observations, actions and next observations of batch size ``[4, 2]`` to try functions on."""
    assert isinstance(task, (Task, ExternalTask))
    sample = StartStates(task) if isinstance(task, Task) else task.sample_starts
    start = sample(16).to(device)
    share = torch.rand(8, task.action_dim)
    low, high = action_bounds(task)
    action = low + (high - low) * share
    return [part.unflatten(0, (4, 2)) for part in (start[:8], action.to(device), start[8:])]


def _function(
    name: str, value: str, transitions: list[Tensor], search_path: Sequence[str] = ()
) -> Callable[..., Tensor]:
    """A user's function, which must be batched torch and return the right dtype.

    Raises:
        ValueError: in one line, naming the setting.
    """
    try:
        function = load_attribute(value, search_path)
    # Loading a file may raise anything.
    except Exception as error:
        why = " ".join(str(error).split())[:200]
        raise ValueError(f"{name}={value}: {why}") from error
    if not callable(function):
        raise ValueError(f"{name}={value} names a {type(function).__name__}, not a function")
    wanted = torch.float32 if name == "reward" else torch.bool
    arguments = "observation, action, next_observation" if name == "reward" else "next_observation"
    for inputs in (transitions, [part.flatten(0, 1) for part in transitions]):
        shape = tuple(inputs[0].shape[:-1])
        try:
            found = function(*inputs)
        # The user's own code may raise anything.
        except Exception as error:
            why = " ".join(str(error).split())[:200]
            raise ValueError(
                f"{name}={value}: {name}({arguments}) failed on tensors of shape {shape} + "
                f"(width,) with {type(error).__name__}: {why}"
            ) from error
        if not isinstance(found, Tensor):
            raise ValueError(f"{name}={value} must return a tensor, got {type(found).__name__}")
        if tuple(found.shape) != shape:
            raise ValueError(
                f"{name}={value} must return shape (...) for tensors of shape (..., width), got "
                f"{tuple(found.shape)} for {shape} + (width,): index entries as x[..., 0] and "
                "sum over dimension -1"
            )
        if found.dtype != wanted:
            raise ValueError(f"{name}={value} must return {wanted}, got {found.dtype}")
        if not bool(found.isfinite().all()):
            raise ValueError(f"{name}={value} is not finite at the task's initial states")
    return function
