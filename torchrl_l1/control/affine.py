"""Models made affine in the action around an operating point, and one step of L1 on them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from types import FunctionType
from typing import NamedTuple, cast

import torch
from torch import Tensor

from torchrl_l1.compilation import CompileMode, compiled
from torchrl_l1.control import kalman_law, law
from torchrl_l1.control.config import Filter, L1Config
from torchrl_l1.control.jacobian import ActionJacobian
from torchrl_l1.control.probe import (
    FORWARD_MODE,
    probe_covariance,
    warn_of_residuals,
    warn_of_shared_effects,
    warn_of_small_effects,
)
from torchrl_l1.control.signals import (
    ControlInput,
    diagnose,
    like,
    narrow,
    saturate,
    wide,
    wide_state,
)
from torchrl_l1.control.state import L1Diagnostics, L1State, ResidualStatistics

BLOCK = 128
"""Batch rows that the ensemble evaluates at once on a CPU.

With more rows, the tangents of wide layers no longer fit in its cache: 256 rows of five members
with 256 units and six actions take 8 MB. With fewer, a small model spends its time on call
overhead.
"""

Step = tuple[Tensor, L1State, L1Diagnostics | None]
Silent = tuple[Tensor, L1State, Callable[[], L1Diagnostics]]
StepFunction = Callable[[L1State, Tensor, Tensor], Step]
"""A step of L1: executed input, next state and, if computed, diagnostics."""


class AffineModel(NamedTuple):
    """``x' = x + drift + jacobian @ u`` around one operating point.

    Attributes:
        drift: ``(..., n)``, state units per step.
        jacobian: ``(..., n, m)``, state units per step and action unit.
    """

    drift: Tensor
    jacobian: Tensor


class Affinization(NamedTuple):
    """A model's value and derivative at the operating input.

    Attributes:
        u_bar: operating input ``(..., m)``.
        value: predicted change at ``u_bar`` ``(..., n)``.
        jacobian: its derivative with respect to the action ``(..., n, m)``.
    """

    u_bar: Tensor
    value: Tensor
    jacobian: Tensor

    def change(self, action: Tensor) -> Tensor:
        """Change of state that the affine model predicts for ``action``: ``(..., n)``."""
        return self.value + (self.jacobian @ (action - self.u_bar).unsqueeze(-1)).squeeze(-1)

    def affine(self) -> AffineModel:
        r"""Drift :math:`\hat f(x, \bar u) - J \bar u` and input matrix :math:`J`.

        arXiv 2403.14860, affinization in section 3.2.
        """
        return AffineModel(self.change(torch.zeros_like(self.u_bar)), self.jacobian)


def affinize(model: ActionJacobian, observation: Tensor, u_bar: Tensor) -> Affinization:
    """Evaluate the model and its Jacobian at ``u_bar``."""
    return Affinization(u_bar, *model.value_and_jacobian(observation, u_bar))


def switching_law(
    model: ActionJacobian,
    observation: Tensor,
    u_bar: Tensor,
    action: Tensor,
    epsilon: float,
) -> tuple[Tensor, Tensor]:
    r"""Test whether the affine model around ``u_bar`` is too inaccurate at ``action``.

    arXiv 2403.14860, switching condition in section 3.2: :math:`\|\hat f^a(x, u; \bar u) - \hat
    f(x, u)\| > \epsilon` (printed there with :math:`\ge`), Euclidean norm in raw state units. An
    error that is NaN does not trigger a switch.

    The affine model is compared at a single input, which takes one directional derivative; the
    Jacobian is evaluated once per step, at the operating point that this law selects.

    Args:
        model: the learned dynamics.
        observation: ``(..., n)``, raw units.
        u_bar: the operating input ``(..., m)``.
        action: the tested input ``(..., m)``.
        epsilon: tolerance, state units.

    Returns:
        switch ``(..., 1)`` (bool) and the error ``(..., 1)``.
    """
    return _exceeds(model.taylor_remainder(observation, u_bar, action), epsilon)


def _exceeds(remainder: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    error = torch.linalg.vector_norm(remainder, dim=-1, keepdim=True)
    return error > epsilon, error


def operating_point(
    model: ActionJacobian,
    observation: Tensor,
    u_bar: Tensor,
    candidate: Tensor,
    tested: Tensor,
    started: Tensor,
    epsilon: float,
) -> tuple[Tensor, Tensor, Affinization]:
    """Apply :func:`switching_law` at ``tested`` and affinize the model at the point it selects.

    Args:
        model: the learned dynamics.
        observation: ``(..., n)``, raw units.
        u_bar: the operating input ``(..., m)``.
        candidate: the input that replaces it at a switch ``(..., m)``.
        tested: where the affine model around ``u_bar`` is tested ``(..., m)``.
        started: ``(..., 1)`` bool, false where there is nothing to switch from.
        epsilon: tolerance, state units.

    Returns:
        switch ``(..., 1)`` (bool), the error ``(..., 1)`` and the model at the selected point.
    """
    remainder, tangent_at = model.expansion(observation, u_bar, candidate, tested)
    switch, error = _exceeds(remainder, epsilon)
    # Rounding may make two evaluations at the same input differ; a first step never switches.
    switch = switch & started
    selected = torch.where(switch, candidate, u_bar)
    return switch, error, Affinization(selected, *tangent_at(switch))


def augment(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
) -> tuple[Tensor, L1State, L1Diagnostics]:
    """Turn the policy's action into the executed input (arXiv 2403.14860, Algorithms 1 and 2).

    If the affine model around the current operating point fails the switching law at the current
    observation, the operating point moves to ``u_rl``. The model is then affinized at the selected
    point, and the adaptive law takes its step on it. The first step of an environment chooses its
    operating point without counting a switch.

    Args:
        config: the settings.
        model: the learned dynamics.
        state: from :func:`torchrl_l1.control.init` or the previous step.
        observation: ``(..., n)``, raw units.
        u_rl: the policy's action ``(..., m)``; it is clipped to the bounds first.

    Returns:
        the executed input ``(..., m)``, the next state and the diagnostics.

    Raises:
        ValueError: if a setting or a shape does not match the state's.

    Examples:
        >>> from torchrl_l1.control import init
        >>> model = ActionJacobian(lambda x, u: -0.1 * x + 0.2 * u.sin())
        >>> state = init([3], observation_dim=1, action_dim=1)
        >>> config = L1Config(0.05, epsilon=0.1)
        >>> u, state, diagnostics = augment(
        ...     config, model, state, torch.ones(3, 1), torch.zeros(3, 1)
        ... )
        >>> state.x_hat.squeeze(-1)
        tensor([0.9000, 0.9000, 0.9000])
    """
    u, following, finish = augment_silently(config, model, state, observation, u_rl)
    return u, following, finish()


def augment_silently(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
) -> Silent:
    """:func:`augment` with the diagnostics as a function, to be called only if wanted."""
    config.check_dimensions(state.x_hat.shape[-1], state.q.shape[-1])
    return _LAWS[config.filter](config, model, state, observation, u_rl)


def _augment_low_pass(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
) -> Silent:
    """:func:`augment_silently` with the paper's law."""
    u_rl = saturate(config, u_rl)
    u_bar = torch.where(state.started, state.u_bar, u_rl)
    fresh = ~state.started
    control = None
    if config.filter_input == "previous":  # which does not depend on the operating point
        control = law.control_input(config, wide_state(state), wide(u_rl), fresh)
    tested = _tested_input(config, model, state, observation, u_rl, u_bar, control)
    switch, error, affinization = operating_point(
        model, observation, u_bar, u_rl, tested, state.started, config.epsilon
    )
    u_bar, change, jacobian = affinization
    # A non-finite prediction at the tested input counts like one at the operating point.
    believed = (error < torch.inf) | fresh
    restart = None
    if config.on_switch == "reset":
        restart, control = switch, None
    residuals = _residuals(config, model, observation, u_bar)
    u, following, terms = law.respond(
        config,
        state,
        observation,
        u_rl,
        change,
        jacobian,
        u_bar,
        restart,
        residuals,
        control,
        believed,
    )
    following = following._replace(
        u_bar=u_bar.masked_fill(terms.non_finite, 0.0), n_switch=state.n_switch + switch
    )

    def diagnostics() -> L1Diagnostics:
        counted = error.masked_fill(terms.non_finite | fresh, 0.0)
        return diagnose(config, terms, switch, counted)

    return u, following, diagnostics


def _augment_kalman(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
) -> Silent:
    """:func:`augment_silently` with the input known before the model is expanded at it."""
    u_rl = saturate(config, u_rl)
    # What the last step expected does not depend on the current input.
    known = model.residual_statistics(observation, u_rl, "residuals")
    estimated = kalman_law.estimate(config, state, observation, known)
    control = kalman_law.adapted(config, estimated, u_rl)
    u = narrow(control.u, u_rl.dtype)
    u_bar, change, jacobian = affinize(model, observation, u)
    residuals = known
    if config.covariance != "residuals":
        residuals = model.residual_statistics(observation, u, config.covariance)
    u, following, terms = kalman_law.follow(
        config, state, estimated, observation, u_rl, change, jacobian, u_bar, residuals, control
    )
    following = following._replace(
        u_bar=u_bar.masked_fill(terms.non_finite, 0.0), n_switch=state.n_switch + state.started
    )
    return u, following, partial(diagnose, config, terms, state.started)


_LAWS: dict[Filter, Callable[..., Silent]] = {
    "low_pass": _augment_low_pass,
    "kalman": _augment_kalman,
}


def _tested_input(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
    u_bar: Tensor,
    control: ControlInput | None,
) -> Tensor:
    """The input at which the switching law tests the affine model ``(..., m)``."""
    if config.switch_on == "policy":
        return u_rl
    if control is None:
        # The executed input depends on the Jacobian, through this step's estimate.
        change, jacobian = model.value_and_jacobian(observation, u_bar)
        residuals = _residuals(config, model, observation, u_bar)
        u, *_ = law.respond(
            config, state, observation, u_rl, change, jacobian, u_bar, None, residuals
        )
        return u
    return narrow(control.u, u_rl.dtype)


def _residuals(
    config: L1Config, model: ActionJacobian, observation: Tensor, u_bar: Tensor
) -> ResidualStatistics | None:
    """The residual statistics by which the adaptive law weighs, if it does."""
    if config.estimator != "weighted":
        return None
    return model.residual_statistics(observation, u_bar, config.covariance)


def make_step(
    config: L1Config, model: ActionJacobian, mode: CompileMode, diagnostics: bool = True
) -> StepFunction:
    """Make the step of L1 as a function of state, observation and action, compiled or not.

    Without ``diagnostics`` it does not compute them and returns ``None`` in their place. Large
    batches pass in blocks of :data:`BLOCK` rows where the model allows it.
    """

    def step(state: L1State, observation: Tensor, u_rl: Tensor) -> Step:
        if diagnostics:
            return augment(config, model, state, observation, u_rl)
        return *augment_silently(config, model, state, observation, u_rl)[:2], None

    known = ("residual_statistics", "residual_covariance")
    is_known = any(callable(getattr(model.dynamics, name, None)) for name in known)
    if config.needs_covariance and not is_known:
        weighted = config.estimator == "weighted"
        setting = "estimator='weighted'" if weighted else f"filter={config.filter!r}"
        warnings.warn(
            f"{setting} finds no covariance of {type(model.dynamics).__name__}'s residuals and "
            "uses the identity: give the model a residual_covariance(observation, action), or fit "
            "an EnsembleDynamics, which measures its own",
            stacklevel=3,
        )

    # Environments keep their batch size, so dynamic sizes would only cost time, and torch cannot
    # make dual tensors of them, which forward-mode Jacobians need.
    whole = compiled(cast(FunctionType, step), mode, dynamic=False)
    whole = partial(_in_blocks, whole) if model.blockwise else whole
    return _prepared(whole, config, model)


def _prepared(step: StepFunction, config: L1Config, model: ActionJacobian) -> StepFunction:
    """The step of a model that is checked before the first step and after ``train()``."""
    # Another controller may have checked the model, but not for what this one needs of it.
    is_checked = False

    def prepared(state: L1State, observation: Tensor, u_rl: Tensor) -> Step:
        nonlocal is_checked
        nothing_to_see = observation.shape[:-1].numel() == 0
        if (is_checked and model.ready) or nothing_to_see or torch.compiler.is_compiling():
            return step(state, observation, u_rl)
        with FORWARD_MODE:  # where the step is compiled, torch differentiates while it traces
            action = saturate(config, u_rl)
            is_known = model.ready
            model.prepare(observation, action)
            if not is_known or config.needs_calibration:
                _, jacobian = model.value_and_jacobian(observation, action)
            if not is_known:
                reach = like(jacobian, config.half_range)
                warn_of_small_effects(model.dynamics, jacobian, observation, reach)
            if config.needs_covariance:
                probe_covariance(
                    model.dynamics,
                    lambda x, u: model.residual_statistics(x, u, config.covariance).covariance,
                    observation,
                    action,
                    is_whole=config.estimator == "weighted",
                    is_late=config.covariance_is_late,
                )
                is_calibrated = not config.needs_calibration or config.inflation is not None
                warn_of_residuals(model.dynamics, is_calibrated=is_calibrated)
            if config.needs_calibration:
                known = model.residual_statistics(observation, action, config.covariance)
                warn_of_shared_effects(model.dynamics, jacobian, known.covariance)
            is_checked = True
            return step(state, observation, u_rl)

    return prepared


def _in_blocks(step: StepFunction, state: L1State, observation: Tensor, u_rl: Tensor) -> Step:
    batch = observation.shape[:-1]
    if batch.numel() <= BLOCK or observation.device.type != "cpu":
        return step(state, observation, u_rl)
    names = list(state.entries())
    entries = (*state.entries().values(), observation, u_rl)
    rows = (x.reshape(-1, x.shape[-1]).split(BLOCK) for x in entries)
    steps = [
        step(L1State(**dict(zip(names, x[:-2], strict=True))), *x[-2:])
        for x in zip(*rows, strict=True)
    ]

    def joined(parts: tuple[Tensor, ...]) -> Tensor:
        return torch.cat(parts).reshape(*batch, -1)

    executed, states, signals = zip(*steps, strict=True)
    following = zip(*(list(x.entries().values()) for x in states), strict=True)
    return (
        joined(executed),
        L1State(**dict(zip(names, map(joined, following), strict=True))),
        None if signals[0] is None else L1Diagnostics(*map(joined, zip(*signals, strict=True))),
    )
