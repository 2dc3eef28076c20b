"""Processing of signals common to all adaptive laws: bounds, types, faults, diagnostics."""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import torch
from torch import Tensor

from torchrl_l1.control import kalman
from torchrl_l1.control.config import L1Config, Scalars
from torchrl_l1.control.kalman import Posterior
from torchrl_l1.control.state import L1Diagnostics, L1State

_HALF = (torch.float16, torch.bfloat16)


def saturate(config: L1Config, action: Tensor) -> Tensor:
    """The action within the configured bounds."""
    low, high = config.action_low, config.action_high
    if isinstance(low, tuple) or isinstance(high, tuple):
        # The configuration expands a number given beside a tuple, so neither is a plain number
        # here.
        low_bound = None if low is None else like(action, low)
        high_bound = None if high is None else like(action, high)
        return torch.clamp(action, low_bound, high_bound)  # type: ignore[arg-type]
    if low is None and high is None:
        return action
    return torch.clamp(action, _number(action, low), _number(action, high))


def project(config: L1Config, sigma_m: Tensor) -> Tensor:
    r"""The matched estimate within :attr:`L1Config.matched_bound`.

    This is the projection of adaptive control onto a box. The authors' formulas have none, but
    least squares with an almost vanishing :math:`J` turns any prediction error into an unbounded
    estimate, which the low-pass filter would take long to forget.
    """
    bound = config.matched_bound
    if bound is None:
        return sigma_m
    if isinstance(bound, tuple):
        limit = cast(Tensor, like(sigma_m, bound))
        return torch.clamp(sigma_m, -limit, limit)
    number = cast(float, _number(sigma_m, bound))
    return torch.clamp(sigma_m, -number, number)


def like(tensor: Tensor, value: Scalars) -> Tensor | float:
    """A setting to compute with; a number stays a number, which needs no device and no kernel."""
    if isinstance(value, tuple):
        return torch.tensor(value, dtype=tensor.dtype, device=tensor.device)
    return value


def _number(tensor: Tensor, bound: Scalars | None) -> float | None:
    """A bound that the tensor's type can hold, as torch requires."""
    if bound is None or isinstance(bound, tuple) or math.isinf(bound):
        return cast(float | None, bound)
    largest = torch.finfo(tensor.dtype).max
    return min(max(bound, -largest), largest)


def wide(tensor: Tensor) -> Tensor:
    """The tensor in a type that can be computed with: half precision becomes single precision.

    Normal equations square the condition number, and squares of half-precision numbers overflow at
    256.
    """
    return tensor.float() if tensor.dtype in _HALF else tensor


def wide_state(state: L1State) -> L1State:
    """:func:`wide` of each entry."""
    if state.x_hat.dtype not in _HALF:
        return state
    return L1State(**{name: wide(value) for name, value in state.entries().items()})


def narrow(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """The tensor in another type, with values beyond its range set to its largest number."""
    if tensor.dtype == dtype or not tensor.is_floating_point():
        return tensor
    largest = torch.finfo(dtype).max
    return tensor.clamp(-largest, largest).to(dtype)


def narrow_state(state: L1State, dtype: torch.dtype) -> L1State:
    """:func:`narrow` of the entries that have the type of the model, see :func:`init`."""
    if dtype not in _HALF:
        return state
    return state._replace(x_hat=narrow(state.x_hat, dtype), u_bar=narrow(state.u_bar, dtype))


def credible(config: L1Config, dtype: torch.dtype, x_err: Tensor, *states: Tensor) -> Tensor:
    """Whether a step's numbers can be computed with: ``(..., 1)``, bool.

    All of them must be finite, the prediction error must not exceed :attr:`L1Config.max_error`, and
    no state may be so large that its last digit exceeds it.

    Args:
        config: the settings.
        dtype: type of the state.
        x_err: prediction error ``(..., n)``.
        states: observations and predictions, each ``(..., n)``.
    """
    # Norms are sums of squares.
    limit = min(config.max_error, 1e-3 * torch.finfo(x_err.dtype).max ** 0.5)
    kind = torch.finfo(dtype)
    rounding = max(kind.eps, limit / kind.max)
    largest = torch.linalg.vector_norm(
        torch.cat([x_err, *(rounding * state for state in states)], -1), torch.inf, -1, True
    )
    return largest <= limit  # comparisons with NaN are false


class ControlInput(NamedTuple):
    """What an adaptive law turns the policy's action into.

    Attributes:
        q: what it subtracts; the low-pass filter's next state ``(..., m)``.
        unbounded: ``u_rl - q`` ``(..., m)``.
        u: the same within the bounds: the executed input ``(..., m)``.
    """

    q: Tensor
    unbounded: Tensor
    u: Tensor

    @classmethod
    def of(cls, config: L1Config, u_rl: Tensor, q: Tensor) -> ControlInput:
        """The policy's action ``(..., m)`` minus ``q``."""
        unbounded = u_rl - q
        return cls(q, unbounded, saturate(config, unbounded))


class Terms(NamedTuple):
    """The terms from which :func:`diagnose` makes its signals, in state units per step.

    Attributes:
        x_err: state prediction error ``(..., n)``.
        estimate: the uncertainty estimate ``(..., n)``.
        effect_matched: the part that an action could cancel ``(..., n)``.
        control: the input.
        ill_conditioned: see :func:`~torchrl_l1.control.solve_matched`.
        non_finite: an input was not finite, or not believed ``(..., 1)``, bool.
        dtype: type of the state.
        posterior: posterior of the matched disturbance, with a Kalman filter.
        skill: sums of :func:`~torchrl_l1.control.kalman.record_forecast`, with a record.
    """

    x_err: Tensor
    estimate: Tensor
    effect_matched: Tensor
    control: ControlInput
    ill_conditioned: Tensor
    non_finite: Tensor
    dtype: torch.dtype
    posterior: Posterior | None = None
    skill: Tensor | None = None


def diagnose(
    config: L1Config,
    terms: Terms,
    switch: Tensor | None = None,
    affinization_error: Tensor | None = None,
) -> L1Diagnostics:
    """The diagnostics of a step, with those of the switching law if given."""
    x_err, estimate, effect_matched, (q, unbounded, u) = terms[:4]
    ill_conditioned, non_finite, dtype, posterior, skill = terms[4:]
    norms = torch.linalg.vector_norm(
        torch.stack([x_err, effect_matched, estimate - effect_matched], dim=-2), dim=-1
    )
    norms = norms.masked_fill(non_finite, 0.0)
    prediction_error, matched, unmatched = norms.split_with_sizes([1, 1, 1], -1)
    diagnostics = L1Diagnostics(
        switch=torch.zeros_like(non_finite) if switch is None else switch,
        affinization_error=(
            torch.zeros_like(prediction_error)
            if affinization_error is None
            else wide(affinization_error)
        ),
        prediction_error=prediction_error,
        matched=matched / config.dt,
        unmatched=unmatched / config.dt,
        u_a=torch.linalg.vector_norm(q, dim=-1, keepdim=True).clamp_max(torch.finfo(q.dtype).max),
        saturation=_share((unbounded != u) & ~non_finite, q.dtype),
        ill_conditioned=ill_conditioned,
        non_finite=non_finite,
        **_significance(posterior, prediction_error),
        forecast_skill=torch.ones_like(prediction_error) if skill is None else kalman.skill(skill),
    )
    if dtype not in _HALF:
        return diagnostics
    return L1Diagnostics(*(narrow(value, dtype) for value in diagnostics))


def _share(flags: Tensor, dtype: torch.dtype) -> Tensor:
    share = flags.to(dtype)
    return share if flags.shape[-1] == 1 else share.mean(-1, keepdim=True)


def _significance(posterior: Posterior | None, like: Tensor) -> dict[str, Tensor]:
    if posterior is None:
        zero = torch.zeros_like(like)
        return {"posterior_deviation": zero, "significance": zero}
    deviation, significance = kalman.summary(posterior)
    return {"posterior_deviation": deviation, "significance": significance}
