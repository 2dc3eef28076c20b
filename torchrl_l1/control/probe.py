"""A check of a model before its first step: does it meet what L1 requires of it?"""

from __future__ import annotations

import dis
import functools
import os
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from types import FunctionType
from typing import Literal

import torch
from torch import Tensor, nn

from torchrl_l1.control.least_squares import whitened, without_effect
from torchrl_l1.control.signals import wide

Mode = Literal["analytic", "forward", "reverse"]
ChangeFunction = Callable[[Tensor, Tensor], Tensor]
JacobianFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]

MOST_ROWS = 256
"""Of larger batches, only these first rows are checked."""

_PARALLEL = 1e-3  # Squared; that of effects of two actions that are 2.5 degrees apart.
_LARGEST = 1e6  # Larger values are skipped: their squares may overflow in an honest model.

_RANDOM = (nn.modules.dropout._DropoutNd, nn.RReLU)


class _ForkSafeLock:
    """A reentrant lock, free in a process that was forked while another thread held it."""

    def __init__(self) -> None:
        self._renew()
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._renew)

    def _renew(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


FORWARD_MODE = _ForkSafeLock()
"""Held during forward-mode differentiation, whose levels all threads of a process share."""


def probe(
    dynamics: object,
    change: ChangeFunction,
    jacobians: Mapping[Mode, JacobianFunction],
    observation: Tensor,
    action: Tensor,
) -> Mode:
    """Check a model on the data of a first step and choose how it is differentiated.

    The first call is a plain one, which gives lazy layers their weights before they meet torch's
    function transforms. The global random state stays untouched. Data that are not finite, or
    beyond 1e6, are replaced by zeros.

    Args:
        dynamics: the model, to be named in errors.
        change: its predicted change ``(..., n)``; must check type and shape of its result.
        jacobians: functions for value and Jacobian by mode, in order of preference.
        observation: ``(..., n)``.
        action: ``(..., m)``.

    Returns:
        the first mode that works. A mode other than the first causes a warning, and so does a
        prediction that does not depend on the action.

    Raises:
        TypeError: if the prediction is not a tensor of the observation's type.
        ValueError: if the prediction has the wrong shape, is not finite, changes from call to call
            or with the other rows of the batch, or has no derivative although it depends on the
            action; or if a layer is in train mode that must not be.
        RuntimeError: if no mode works.
    """
    refuse_training(dynamics)
    observation, action = _moderate(observation), _moderate(action)
    rows = observation.shape[:-1].numel()
    if rows > MOST_ROWS:
        observation = observation.reshape(rows, -1)[:MOST_ROWS]
        action = action.reshape(rows, -1)[:MOST_ROWS]
    _warn_of_units(dynamics, observation)
    devices = [observation.device] if observation.device.type == "cuda" else []
    with torch.no_grad(), torch.random.fork_rng(devices):
        given = observation.clone(), action.clone()
        value = change(*given)
        _check_unwritten(dynamics, given, (observation, action))
        _check_repeatable(dynamics, change, observation, action, value)
        _check_rows(dynamics, change, observation, action, value)
        return _choose_mode(dynamics, change, jacobians, observation, action, value)


def probe_covariance(
    dynamics: object,
    covariance_of: ChangeFunction,
    observation: Tensor,
    action: Tensor,
    *,
    is_whole: bool = True,
    is_late: bool = False,
) -> None:
    """Check the covariance of a model's residuals on the data of a first step.

    Args:
        dynamics: the model, to be named in errors.
        covariance_of: gives it for observation and action: ``(n, n)``, or ``(..., n, n)``.
        observation: ``(..., n)``.
        action: ``(..., m)``.
        is_whole: whether residuals are whitened with all of it, not just with its diagonal's mean.
        is_late: whether it is evaluated at the step after that of the residual.

    Raises:
        TypeError: if it is not a tensor of the observation's type.
        ValueError: if its shape is wrong, or it is not positive definite.
    """
    observation, action = _moderate(observation), _moderate(action)
    name, n = f"the residual covariance of {describe(dynamics)}", observation.shape[-1]
    with torch.no_grad():
        found = covariance_of(observation, action)
        if not isinstance(found, Tensor) or found.dtype != observation.dtype:
            kind = found.dtype if isinstance(found, Tensor) else type(found).__name__
            raise TypeError(f"{name} is {kind}, expected a tensor of {observation.dtype}")
        if found.shape not in ((n, n), (*observation.shape, n)):
            raise ValueError(
                f"{name} has shape {tuple(found.shape)}, expected {(n, n)} or "
                f"{(*observation.shape, n)}"
            )
        if not is_positive(found, is_whole):
            raise ValueError(
                f"{name} is not finite and positive definite: give states without errors a small "
                "variance"
            )
        if is_late and found.ndim > 2:
            other = covariance_of(1.0 - 2.0 * observation, 1.0 - 2.0 * action)
            if not torch.allclose(found, other):
                warnings.warn(
                    f"{name} depends on the state, which covariance='residuals' does not expect: "
                    "give covariance='sum', with which each step remembers that of the last",
                    stacklevel=2,
                )


def warn_of_residuals(dynamics: object, *, is_calibrated: bool) -> None:
    """Warn if a model does not know its residuals, or how far to trust them.

    Args:
        dynamics: the model, to be named in warnings.
        is_calibrated: whether the latter is given, or does not matter.
    """
    residuals = getattr(dynamics, "residuals", None)
    if is_calibrated:
        measured = getattr(residuals, "measured", None)
        if isinstance(measured, Tensor) and not bool(measured):
            warnings.warn(
                f"the residuals of {describe(dynamics)} have not been measured, so their "
                "covariance is taken to be the identity: fit the model with fit_ensemble, or "
                "call model.residuals.measure() after your own training",
                stacklevel=2,
            )
        return
    calibrated = getattr(residuals, "calibrated", None)
    if isinstance(calibrated, Tensor) and not bool(calibrated):
        warnings.warn(
            f"the Kalman filter treats the residuals of {describe(dynamics)} as white noise, "
            "since they are not calibrated: after the fit, call "
            "calibrate_filter(model.residuals, model.value_and_jacobian, data, config) with "
            "episodes of at least 20 steps, or give inflation",
            stacklevel=2,
        )


@torch.no_grad()
def warn_of_small_effects(
    dynamics: object, jacobian: Tensor, observation: Tensor, reach: Tensor | float
) -> None:
    """Warn of actions whose effect at a first step is there, but too small to be acted on.

    Args:
        dynamics: the model, to be named in the warning.
        jacobian: ``(..., n, m)``.
        observation: ``(..., n)``.
        reach: half the range of each action ``(m,)``, or a number.
    """
    jacobian, size = wide(jacobian), wide(observation).abs()
    small = without_effect(jacobian, size, reach) & (jacobian != 0).any(-2)
    entries = small.reshape(-1, small.shape[-1]).all(0).nonzero().flatten().tolist()
    if entries:
        warnings.warn(
            f"at the first step of {describe(dynamics)} the effect of the actions {entries} is "
            "lost in rounding, and L1 leaves them alone: if states are small numbers, as positions "
            "of micrometres in metres, give the model and L1 smaller units",
            stacklevel=2,
        )


@torch.no_grad()
def warn_of_shared_effects(dynamics: object, jacobian: Tensor, covariance: Tensor) -> None:
    """Warn of actions that a controller which judges each by itself cannot tell apart.

    Args:
        dynamics: the model, to be named in the warning.
        jacobian: ``(..., n, m)``.
        covariance: of the residuals, ``(n, n)`` or ``(..., n, n)``.
    """
    columns = whitened(wide(covariance), wide(jacobian))[0].double()
    columns = columns.reshape(-1, *columns.shape[-2:])
    columns = columns[columns.isfinite().flatten(1).all(1)]
    length = torch.linalg.vector_norm(columns, dim=-2)
    columns = columns / length.clamp_min(torch.finfo(length.dtype).tiny).unsqueeze(-2)
    values, vectors = torch.linalg.eigh(columns.mT @ columns)
    # The share of each action in the combinations that have no effect.
    share = (vectors.square() * (values < _PARALLEL).unsqueeze(-2)).sum(-1)
    entries = ((share > 0.01) & (length > 0)).all(0).nonzero().flatten().tolist()
    if entries and len(columns):
        warnings.warn(
            f"at the first step of {describe(dynamics)} the effects of the actions {entries} "
            "cannot be told apart, and the robust controller acts on each only as far as it is "
            "known by itself, perhaps never: make one action of actuators that do the same, or use "
            "the paper's controller",
            stacklevel=2,
        )


def is_positive(covariance: Tensor, is_whole: bool = True) -> bool:
    """Whether covariances ``(..., n, n)`` are positive definite; if not whole, in the mean only."""
    covariance = covariance.to(torch.promote_types(covariance.dtype, torch.float32))
    if not is_whole:
        return bool((covariance.diagonal(dim1=-2, dim2=-1).mean(-1) > 0).all())
    factor, info = torch.linalg.cholesky_ex(covariance)
    return not bool(info.any()) and bool(factor.isfinite().all())


def _warn_of_units(dynamics: object, observation: Tensor) -> None:
    """Warn if the first observations lie far from the data that a model reports having seen."""
    box = getattr(dynamics, "box", None)
    low, high = getattr(box, "low", None), getattr(box, "high", None)
    if not (isinstance(low, Tensor) and isinstance(high, Tensor) and low.shape == high.shape):
        return
    if low.shape != observation.shape[-1:]:
        return
    width = high - low
    rows = observation.reshape(-1, observation.shape[-1])
    beyond = torch.maximum(rows - high, low - rows) > width
    # Infinite before a fit, and zero in width where the data do not vary.
    far = (beyond & width.isfinite() & (width > 0)).float().mean(0) > 0.5
    if far.any():
        entries = far.nonzero().flatten().tolist()
        warnings.warn(
            f"the first observation lies far from the data that {describe(dynamics)} was fitted "
            f"to, in the entries {entries}: is it in other units, as behind a normaliser, or the "
            "model one of another plant?",
            stacklevel=2,
        )


def refuse_training(dynamics: object) -> None:
    """Reject layers that are random, or mix the rows of a batch, in train mode.

    Raises:
        ValueError: naming the first such layer and the remedy.
    """
    for root in _modules(dynamics):
        for name, layer in root.named_modules():
            # After torch.jit.freeze a module has no mode any more.
            if getattr(layer, "training", False) and _needs_eval(layer):
                raise ValueError(
                    f"{describe(dynamics)} is in train mode, in which its layer "
                    f"{_label(name, layer)} gives L1 another prediction at each call or mixes the "
                    "environments of a batch: call its eval() before the first step, and again "
                    "after each fit"
                )


def watched(dynamics: object) -> list[nn.Module]:
    """Modules of which a change of mode may matter: outermost ones, and those refused in train."""
    roots = list(_modules(dynamics))
    layers = [layer for root in roots for layer in root.modules() if _needs_eval(layer)]
    return [one for one in (*roots, *layers) if hasattr(one, "training")]


def _needs_eval(layer: nn.Module) -> bool:
    if isinstance(layer, _RANDOM):
        return getattr(layer, "p", 1.0) > 0
    if isinstance(layer, nn.RNNBase):
        return layer.dropout > 0 and layer.num_layers > 1
    if isinstance(layer, nn.MultiheadAttention):
        return layer.dropout > 0
    if isinstance(layer, nn.modules.batchnorm._BatchNorm):
        return True
    return isinstance(layer, nn.modules.batchnorm._NormBase) and layer.track_running_stats


def _modules(dynamics: object) -> Iterator[nn.Module]:
    """The modules of which a model consists, as far as they can be found."""
    if isinstance(dynamics, nn.Module):
        yield dynamics
    elif isinstance(dynamics, functools.partial):
        for part in (dynamics.func, *dynamics.args, *dynamics.keywords.values()):
            yield from _modules(part)
    elif hasattr(dynamics, "__self__"):
        yield from _modules(dynamics.__self__)
    else:
        held = list(vars(dynamics).values()) if hasattr(dynamics, "__dict__") else []
        for cell in getattr(dynamics, "__closure__", None) or ():
            with suppress(ValueError):  # an empty cell
                held.append(cell.cell_contents)
        if isinstance(dynamics, FunctionType):
            names = (
                one.argval for one in dis.get_instructions(dynamics) if one.opname == "LOAD_GLOBAL"
            )
            held += [dynamics.__globals__.get(name) for name in names]
        yield from (part for part in held if isinstance(part, nn.Module))


def _moderate(data: Tensor) -> Tensor:
    return torch.where(data.abs() <= _LARGEST, data, 0.0)


def _differ(a: Tensor, b: Tensor, observation: Tensor) -> bool:
    """Whether two predicted changes, from this observation, differ by more than rounding."""
    size = max(float(x.abs().max()) if x.numel() else 0.0 for x in (a, observation))
    return not bool(((a - b).abs() <= 16 * torch.finfo(a.dtype).eps * size).all())


def _check_unwritten(
    dynamics: object, given: tuple[Tensor, Tensor], before: tuple[Tensor, Tensor]
) -> None:
    """Reject a model that modifies its inputs in place: they are the environment's tensors."""
    for name, one, other in zip(("observation", "action"), given, before, strict=True):
        # A write may leave the values unchanged; tensors in inference mode do not count writes.
        written = not one.is_inference() and one._version > 0
        if written or not torch.equal(one, other):
            raise ValueError(
                f"{describe(dynamics)} writes to its {name} in place, which belongs to the "
                "environment: let it work on a copy"
            )


def _check_repeatable(
    dynamics: object, change: ChangeFunction, observation: Tensor, action: Tensor, value: Tensor
) -> None:
    if not bool(value.isfinite().all()):
        raise ValueError(
            f"{describe(dynamics)} gives a prediction that is not finite at the first observation "
            "and action"
        )
    if _differ(value, change(observation, action), observation):
        raise ValueError(
            f"{describe(dynamics)} gives another prediction at each call for the same observation "
            "and action: L1 needs the mean, without sampling or dropout (eval mode)"
        )


def _check_rows(
    dynamics: object, change: ChangeFunction, observation: Tensor, action: Tensor, value: Tensor
) -> None:
    """Change one row of the batch and see whether another row's prediction changes."""
    n = observation.shape[-1]
    if observation.shape[:-1].numel() == 1:
        # Alone in its batch. There are batches only if two copies of a row are predicted like one.
        twice = [torch.stack([data.reshape(-1)] * 2) for data in (observation, action)]
        try:
            pair = change(*twice)
        except Exception:
            return  # a function of vectors
        if _differ(pair, value.reshape(1, n).expand(2, n), observation):
            return
        observation, action, value = *twice, pair
    others = observation.clone().reshape(-1, n), action.clone().reshape(-1, action.shape[-1])
    for data in others:
        data[0] = 1.0 - 2.0 * data[0]
    moved = change(others[0].reshape(observation.shape), others[1].reshape(action.shape))
    if _differ(value.reshape(-1, n)[1:], moved.reshape(-1, n)[1:], observation):
        raise ValueError(
            f"{describe(dynamics)} mixes the rows of a batch: what it predicts for one environment "
            "changes with the others' (batch norm in train mode, attention along the wrong "
            "dimension); each row must be predicted by itself"
        )


def _choose_mode(
    dynamics: object,
    change: ChangeFunction,
    jacobians: Mapping[Mode, JacobianFunction],
    observation: Tensor,
    action: Tensor,
    value: Tensor,
) -> Mode:
    # Somewhere else: at one action an honest network may be dead or saturated.
    others = [0.5 * action, -action, action + 1.0, action - 1.0]
    failures: dict[Mode, Exception] = {}
    flat: Mode | None = None
    for mode, jacobian in jacobians.items():
        try:
            if any(bool((jacobian(observation, u)[1] != 0).any()) for u in [action, *others]):
                _warn_of_reverse(dynamics, mode, failures, observation, action)
                return mode
            flat = flat or mode
        except Exception as error:
            failures[mode] = error
    if flat is None:
        if "analytic" in failures:
            raise failures["analytic"]
        raise RuntimeError(_no_mode(dynamics, failures)) from next(iter(failures.values()))
    if any(_differ(value, change(observation, u), observation) for u in others):
        raise ValueError(
            f"{describe(dynamics)} predicts a change that depends on the action, but its "
            "derivative with respect to the action is zero: it is detached (detach, no_grad, "
            "NumPy) or piecewise constant; keep the graph, or give the model a method "
            "value_and_jacobian(observation, action)"
        )
    warnings.warn(
        f"{describe(dynamics)} predicts a change that does not depend on the action: L1 flags each "
        "step as ill conditioned and adds nothing",
        stacklevel=2,
    )
    _warn_of_reverse(dynamics, flat, failures, observation, action)
    return flat


def _warn_of_reverse(
    dynamics: object,
    mode: Mode,
    failures: Mapping[Mode, Exception],
    observation: Tensor,
    action: Tensor,
) -> None:
    if mode != "reverse":
        return
    n, m = observation.shape[-1], action.shape[-1]
    error = failures.get("forward")
    cause = "" if error is None else f", since {_culprit(dynamics, error)} has no forward mode"
    warnings.warn(
        f"{describe(dynamics)} is differentiated in reverse mode{cause}: a Jacobian takes {n} "
        f"backward passes in place of {m} forward ones, and a step one Jacobian or two",
        stacklevel=2,
    )


def failure(dynamics: object, observation: Tensor, action: Tensor, error: Exception) -> ValueError:
    """The error to raise if a model cannot be called at all."""
    return ValueError(
        f"{describe(dynamics)} failed at its first call; L1 calls a model with two arguments, an "
        f"observation of shape {tuple(observation.shape)} and an action of shape "
        f"{tuple(action.shape)}, both {observation.dtype}: {_first_line(error)}"
    )


def _no_mode(dynamics: object, failures: Mapping[Mode, Exception]) -> str:
    causes = "; ".join(f"{mode} mode: {_first_line(error)}" for mode, error in failures.items())
    culprit = _culprit(dynamics, next(iter(failures.values())))
    return (
        f"{describe(dynamics)} cannot be differentiated at {culprit} ({causes}): write it in "
        "differentiable operations of torch, or give the model a method "
        "value_and_jacobian(observation, action)"
    )


def _first_line(error: Exception) -> str:
    line = str(error).strip().partition("\n")[0]
    return f"{type(error).__name__}: {line[:160]}"


def _culprit(dynamics: object, error: Exception) -> str:
    """The innermost module that was running when the error was raised."""
    names = {
        id(layer): _label(name, layer)
        for root in _modules(dynamics)
        for name, layer in root.named_modules()
    }
    found = describe(dynamics)
    trace = error.__traceback__
    while trace is not None:
        owner = trace.tb_frame.f_locals.get("self")
        if isinstance(owner, nn.Module):
            found = names.get(id(owner), type(owner).__name__)
        trace = trace.tb_next
    return found


def _label(name: str, layer: nn.Module) -> str:
    return f"{name} ({type(layer).__name__})" if name else type(layer).__name__


def describe(dynamics: object) -> str:
    """A model's name in a message."""
    name = getattr(dynamics, "__qualname__", None)
    return f"the model {name if isinstance(name, str) else type(dynamics).__name__}"
