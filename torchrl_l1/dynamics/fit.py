"""Fitting an ensemble to real transitions: settings and training loop."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from inspect import signature
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_l1.checks import (
    check_counts,
    check_not_negative,
    check_optional_count,
    check_positive,
    check_within,
)
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics.factory import make_dynamics
from torchrl_l1.dynamics.loss import EnsembleDynamicsLoss, evaluate_members
from torchrl_l1.dynamics.model import EnsembleDynamics
from torchrl_l1.dynamics.network import model_precision, resolve_precision
from torchrl_l1.dynamics.quality import entry_names
from torchrl_l1.dynamics.residuals import calibrate_filter
from torchrl_l1.dynamics.training_step import Members, TrainingStep
from torchrl_l1.dynamics.transitions import Data, Transitions, read_transitions, two_parts
from torchrl_l1.dynamics.validation import measure_quality, one_step_residuals


@dataclass
class FitConfig:
    """How an ensemble is fitted.

    Attributes:
        learning_rate: Adam's step size at the start of a fit.
        final_learning_rate_fraction: the final step size as a fraction of the initial one, reached
            linearly over the gradient steps that a fit may take.
        batch_size: transitions per member and gradient step.
        max_epochs: maximum number of passes over the training data.
        max_gradient_steps: maximum number of gradient steps, whatever the number of epochs.
        patience: epochs without a lower validation loss of any member after which to stop.
        validation_fraction: share of new transitions permanently kept out of training.
        weight_penalty: coefficient of half the squared hidden weights, divided by the number
            of training transitions.
        weight_decay: coefficients of half the squared weights, one per layer from input to output,
            biases excepted; none if empty. The authors of PETS state theirs for twice the negative
            log-likelihood, or half the squared error: half of each has the same effect here with a
            Gaussian head, twice with a deterministic one.
        bootstrap: whether each member trains on its own resample of the training transitions:
            equally many, drawn with replacement for each fit. All members share the validation
            data.
        elites: number of members with the lowest validation loss that become the model's elites
            after the fit; if null, the model's elites stay as they are.
        precision: precision of the products of hidden units and of their gradients, ``float32``,
            ``bfloat16``, or ``auto`` for the faster one on this machine, see
            :func:`~torchrl_l1.planning.resolve_precision`. Weights, optimizer moments and
            validation are always float32.
    """

    learning_rate: float = 1e-3
    final_learning_rate_fraction: float = 0.1
    batch_size: int = 500
    max_epochs: int = 50
    max_gradient_steps: int = 800
    patience: int = 5
    validation_fraction: float = 0.1
    weight_penalty: float = 0.0
    weight_decay: list[float] = field(default_factory=list)
    bootstrap: bool = False
    elites: int | None = None
    precision: str = "float32"

    def __post_init__(self) -> None:
        counts = ("batch_size", "max_epochs", "max_gradient_steps", "patience")
        check_counts(self, *counts, prefix="fit.")
        check_within("fit.validation_fraction", self.validation_fraction, "(0, 1)")
        check_positive("fit.learning_rate", self.learning_rate)
        fraction = self.final_learning_rate_fraction
        check_within("fit.final_learning_rate_fraction", fraction, "(0, 1]")
        check_not_negative("fit.weight_penalty", self.weight_penalty)
        for layer, coefficient in enumerate(self.weight_decay):
            check_not_negative(f"fit.weight_decay[{layer}]", coefficient)
        check_optional_count("fit.elites", self.elites)
        resolve_precision(self.precision, name="fit.precision")


FROM_SCRATCH: dict[str, Any] = {
    "max_epochs": 200,
    "max_gradient_steps": 3000,
    "patience": 10,
    "batch_size": 256,
}
""":class:`FitConfig` settings for a model that is fitted once, by :func:`fit_dynamics`."""


@dataclass
class FitReport:
    """Outcome of a fit, averaged over the members.

    Attributes:
        train_loss: running mean of the loss over the last epoch, while the weights changed.
        validation_loss: validation loss of the weights that were kept.
        epochs: passes over the training data.
        gradient_steps: gradient steps taken.
        dropped: rows left out because they are not transitions of the system.
    """

    train_loss: float
    validation_loss: float
    epochs: int
    gradient_steps: int
    dropped: int = 0


def fit_ensemble(
    dynamics: EnsembleDynamics,
    data: Data,
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
    action_key: NestedKey = "action",
    on_epoch: Callable[[int], None] | None = None,
    observation_key: NestedKey = "observation",
    seed: int = 0,
) -> FitReport:
    """Fit all members at once, each on its own shuffle of the training data.

    Normalisers and the data box are first set from the training data. Training continues from the
    current weights. Every member keeps the weights of the epoch with its lowest validation loss;
    parameters that the members share keep those of the last epoch that was the best for any member.

    Args:
        dynamics: the model, changed in place.
        data: transitions with ``observation_key``, ``action_key`` and ``("next",
            observation_key)``: a replay buffer, a tensordict of any batch size or several of them;
            :func:`~torchrl_l1.dynamics.read_transitions` says which rows are used. The flag
            ``validation`` marks what is kept out of training; without it, trajectories are drawn.
        config: see :class:`FitConfig`.
        optimizer: over ``dynamics.parameters()``; its moments persist between fits, and its step
            sizes are set from ``config`` in all of its groups.
        action_key: ``"action"`` for the nominal label, ``"executed"`` for the executed one.
        on_epoch: called with the number of the finished epoch, for progress bars.
        observation_key: key of the observation; ``("next", observation_key)`` is the next one.
        seed: seed for drawing the trajectories kept out of training.

    Raises:
        KeyError: if the data lack a key.
        ValueError: if there is nothing to train or to validate on, if shapes do not fit or if a
            setting does not fit the model. The model is then unchanged.
    """
    check_fit(config, dynamics)
    fraction = config.validation_fraction
    like = dynamics.change_normalizer.mean
    keys = (observation_key, action_key)
    transitions = read_transitions(data, *keys, fraction, seed, like.dtype, like.device)
    return fit_to_transitions(dynamics, transitions, config, optimizer, on_epoch)


def fit_dynamics(
    data: Data,
    *,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    config: FitConfig | None = None,
    seed: int = 0,
    device: torch.device | str | None = None,
    on_epoch: Callable[[int], None] | None = None,
    **settings: Any,
) -> EnsembleDynamics:
    """A dynamics model fitted to your own data, with a measure of how good it is.

    If the data hold 20 steps in a row, this also finds the settings that the robust controller
    takes from the model, like :func:`~torchrl_l1.dynamics.calibrate_filter` with the range of the
    recorded actions as bounds. Call that again if the actuators reach further, or with data free of
    the disturbances to be cancelled.

    Args:
        data: transitions as TorchRL makes them: a replay buffer, a tensordict of any batch size,
            or several of them, see :func:`~torchrl_l1.dynamics.read_transitions`.
        observation_key: key of the observation ``(..., n)``; ``("next", observation_key)`` is the
            next one.
        action_key: key of what was sent to the actuators ``(..., m)``.
        names: names of the observation's entries, for the report.
        units: units of the same.
        config: how to fit; if ``None``, settings for one fit from scratch: up to 3000 gradient
            steps of 256 transitions.
        seed: seed of weights, shuffles and the trajectories kept out of training. The global random
            state stays as it is.
        device: device of the model; the CPU if ``None``.
        on_epoch: called with the number of the finished epoch, for progress bars.
        settings: fields of :class:`FitConfig`, such as ``validation_fraction``, and arguments of
            :func:`~torchrl_l1.dynamics.make_dynamics`, such as ``members``, ``head`` or ``hidden``,
            which is ``(128, 128)`` here by default.

    Returns:
        the model, in evaluation mode, with its :attr:`~EnsembleDynamics.quality`, which prints as a
        table.

    Warns:
        UserWarning: if rows of the data are left out, an entry of the action never varies, changes
            are lost in the digits of large values, or the model is too poor for L1 to be useful.

    Raises:
        KeyError: if the data lack a key.
        TypeError: for a setting that does not exist.
        ValueError: if the data do not suffice, or shapes or settings make no sense.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> x, u = torch.randn(500, 2, dtype=torch.float64), torch.randn(500, 1)
        >>> data = TensorDict({"observation": x, "action": u}, batch_size=[500])
        >>> data["next", "observation"] = 0.9 * x + 0.1 * u
        >>> model = fit_dynamics(data, hidden=(64,), names=["angle", "rate"])
        >>> model.quality.validation
        50
    """
    of_fit = {field.name for field in fields(FitConfig)}
    fitting = {name: settings.pop(name) for name in of_fit & set(settings)}
    config = replace(config or FitConfig(**FROM_SCRATCH), **fitting)
    known = {*signature(make_dynamics).parameters, *signature(EnsembleDynamics).parameters}
    known -= {"observation_dim", "action_dim", "settings"}
    if unknown := sorted(set(settings) - known):
        raise TypeError(
            f"fit_dynamics has no setting {unknown[0]!r}: those of the model are "
            f"{', '.join(sorted(known))}, those of the fit {', '.join(sorted(of_fit))}"
        )
    fraction, here = config.validation_fraction, torch.device(device or "cpu")
    keys = (observation_key, action_key)
    transitions = read_transitions(data, *keys, fraction, seed, torch.get_default_dtype(), here)
    if not transitions.data.shape[0]:
        raise ValueError("cannot fit: the data hold no transitions; collect some first")
    n, m = (transitions.data[key].shape[-1] for key in ("observation", "action"))
    entry_names(n, names, units)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(int(seed))  # all draws are made on the CPU
        dynamics = make_dynamics(n, m, **{"hidden": (128, 128), **settings}).to(here)
        transitions.warn_of_gaps(*keys, std_floor=dynamics.change_normalizer.std_floor)
        optimizer = torch.optim.Adam(dynamics.parameters(), lr=config.learning_rate)
        fit_to_transitions(dynamics, transitions, config, optimizer, on_epoch)
    if not bool(dynamics.residuals.measured):
        raise ValueError("the fit diverged: look at learning_rate and at the scale of the data")
    dynamics.quality = measure_quality(dynamics, transitions, names, units)
    if dynamics.quality.warning:
        warnings.warn(dynamics.quality.warning, stacklevel=2)
    _calibrate(dynamics.eval(), transitions.data)
    return dynamics


def _calibrate(dynamics: EnsembleDynamics, data: TensorDictBase) -> None:
    """The settings with bounds from the data; an entry that never varies gets unit bounds."""
    low, high = data["action"].amin(0), data["action"].amax(0)
    flat = (low == high).to(low)
    # The filter works step by step, so the length of a time step does not matter.
    config = L1Config.robust(1.0, action_low=low - flat, action_high=high + flat)
    calibrate_filter(dynamics.residuals, dynamics.value_and_jacobian, data, config)


def fit_to_transitions(
    dynamics: EnsembleDynamics,
    transitions: Transitions,
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
    on_epoch: Callable[[int], None] | None = None,
) -> FitReport:
    """As :func:`fit_ensemble`, for transitions that have been read."""
    check_fit(config, dynamics)
    words = ("fit", "transitions", "fit.validation_fraction")
    train, validation = two_parts(transitions.data, transitions.validation, *words)
    _check_widths(dynamics, train)
    check_optimizer(optimizer, dynamics)
    dynamics.train()
    change = train["next", "observation"] - train["observation"]
    dynamics.fit_statistics(train["observation"], train["action"], change)
    # Once for all batches: the statistics stay as they are.
    inputs = dynamics.normalize_inputs(train["observation"], train["action"])
    target = dynamics.change_normalizer.normalize(change)
    validate = partial(evaluate_members, EnsembleDynamicsLoss(dynamics), validation)
    best_loss, report = train_members(
        dynamics, inputs, target, validate, config, optimizer, on_epoch
    )
    if config.elites is not None:
        dynamics.set_elites(best_loss.topk(config.elites, largest=False).indices)
    residual = one_step_residuals(dynamics, validation)
    if bool(residual.isfinite().all()):  # otherwise the loss shows that the fit diverged
        moved = validation["next", "observation"] - validation["observation"]
        dynamics.residuals.measure(residual, moved)
    return replace(report, dropped=transitions.dropped)


def train_members(
    model: Members,
    inputs: Tensor,
    target: Tensor,
    validate: Callable[[], Tensor],
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
    on_epoch: Callable[[int], None] | None = None,
) -> tuple[Tensor, FitReport]:
    """The loop of a fit: all members at once, each on its own shuffle of the training data.

    Args:
        model: changed in place; see :func:`fit_ensemble` for the weights that it ends with.
        inputs: normalised ``(N, in)``.
        target: normalised ``(N, out)``.
        validate: losses of the members on the validation data ``(E,)``.
        config: see :class:`FitConfig`; elites and shares of the data are not used here.
        optimizer: over the model's parameters.
        on_epoch: called with the number of the finished epoch.

    Returns:
        validation losses of the weights that were kept ``(E,)``, and the report.
    """
    own, shared = list(model.network.parameters()), list(model.head.parameters())
    training_step = TrainingStep(
        model,
        model_precision(model, config.precision),
        _decay(config, len(model.network.weights), inputs.shape[0]),
    )
    members, size, device = model.network.members, inputs.shape[0], inputs.device
    batch_size = min(config.batch_size, size)
    batches = size // batch_size
    best_loss = torch.full((members,), torch.inf, device=device)
    best_own, best_shared = _copy(own), _copy(shared)
    resample = torch.randint(size, (members, size)).to(device) if config.bootstrap else None
    planned = min(config.max_epochs * batches, config.max_gradient_steps)
    stale = epoch = steps = 0
    while epoch < config.max_epochs and steps < config.max_gradient_steps:
        order = torch.stack([torch.randperm(size) for _ in range(members)]).to(device)
        running = torch.zeros((), device=device)
        for batch in range(batches):
            index = order[:, batch * batch_size : (batch + 1) * batch_size]
            if resample is not None:
                index = resample.gather(1, index)
            running += training_step(_rows(inputs, index), _rows(target, index)).sum()
            decay = 1 - (1 - config.final_learning_rate_fraction) * steps / planned
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * decay
            optimizer.step()
            steps += 1
            if steps == config.max_gradient_steps:
                break
        epoch += 1
        current = validate()
        better = current < best_loss
        best_loss = torch.where(better, current, best_loss)
        for kept, parameter in zip(best_own, own, strict=True):
            kept[better] = parameter.detach()[better]
        if on_epoch is not None:
            on_epoch(epoch)
        improved = bool(better.any())
        best_shared = _copy(shared) if improved else best_shared
        stale = 0 if improved else stale + 1
        if stale >= config.patience:
            break
    with torch.no_grad():
        for kept, parameter in zip(best_own + best_shared, own + shared, strict=True):
            parameter.copy_(kept)
    if shared:  # the best weights of each member are now paired with another epoch's parameters
        best_loss = validate()
    return best_loss, FitReport(
        train_loss=running.item() / (members * (batch + 1)),
        validation_loss=best_loss.mean().item(),
        epochs=epoch,
        gradient_steps=steps,
    )


def _check_widths(dynamics: EnsembleDynamics, data: TensorDictBase) -> None:
    found = data["observation"].shape[-1], data["action"].shape[-1]
    if found != (dynamics.observation_dim, dynamics.action_dim):
        raise ValueError(
            f"the model takes observations of width {dynamics.observation_dim} and actions of "
            f"width {dynamics.action_dim}, the data have {found[0]} and {found[1]}"
        )


def check_optimizer(optimizer: torch.optim.Optimizer, model: Members) -> None:
    """Reject an optimizer that would train none of the networks, such as one made for a copy."""
    known = {id(part) for group in optimizer.param_groups for part in group["params"]}
    trained = [part for part in model.network.parameters() if part.requires_grad]
    if trained and not any(id(part) in known for part in trained):
        raise ValueError(
            "the optimizer holds no weights of this model, maybe those of another model or of one "
            "that it was copied from: make one over this model's parameters()"
        )


def check_fit(config: FitConfig, dynamics: EnsembleDynamics) -> None:
    """Raise ``ValueError`` if settings do not fit the model."""
    check_decay(config, dynamics)
    members = dynamics.members
    if config.elites is not None and config.elites > members:
        raise ValueError(f"fit.elites is {config.elites}, but the model has {members} members")


def check_decay(config: FitConfig, model: Members) -> None:
    """Raise ``ValueError`` if the coefficients are for other layers than the model's."""
    layers = len(model.network.weights)
    if config.weight_decay and len(config.weight_decay) != layers:
        raise ValueError(
            f"fit.weight_decay must hold a coefficient for each of the model's {layers} layers, "
            f"the output layer included, got {len(config.weight_decay)}"
        )


def _rows(data: Tensor, index: Tensor) -> Tensor:
    """Rows ``(E, B, width)`` of ``(N, width)`` at index ``(E, B)``."""
    return data.index_select(0, index.flatten()).unflatten(0, index.shape)


def _copy(parameters: Sequence[Tensor]) -> list[Tensor]:
    return [parameter.detach().clone() for parameter in parameters]


def _decay(config: FitConfig, layers: int, size: int) -> list[float]:
    """Coefficients of half the squared weights, one per layer, or none."""
    if not config.weight_decay and not config.weight_penalty:
        return []
    hidden = config.weight_penalty / size
    given = config.weight_decay or [0.0] * layers
    return [coefficient + hidden for coefficient in given[:-1]] + given[-1:]
