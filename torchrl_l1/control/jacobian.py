"""A model's predicted change of state and its derivative with respect to the action."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_l1.control.module_model import Predicts, read_module
from torchrl_l1.control.probe import (
    FORWARD_MODE,
    ChangeFunction,
    Mode,
    describe,
    failure,
    probe,
    refuse_training,
    watched,
)
from torchrl_l1.control.state import ResidualStatistics

Expansion = tuple[Tensor, Callable[[Tensor], tuple[Tensor, Tensor]]]


@runtime_checkable
class DynamicsModel(Protocol):
    """What the L1 controller needs of a learned model.

    A model may also have ``value_and_jacobian(observation, action)``, which returns the same change
    ``(..., n)`` together with its derivative with respect to the action ``(..., n, m)`` in raw
    units. It is then used in place of automatic differentiation. So are two further optional
    methods: ``taylor_remainder(observation, u_bar, action)``, which returns the difference between
    the change at ``action`` and the tangent at ``u_bar`` ``(..., n)``, and ``expansion(observation,
    u_bar, candidate, tested)``, which combines the two, see :meth:`ActionJacobian.expansion`. The
    controller evaluates the latter in blocks of a batch's rows, so no row may depend on another.
    """

    def mean_change(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predicted change of state: ``(..., n)`` and ``(..., m)`` to ``(..., n)``."""
        ...


class ActionJacobian:
    r"""Value :math:`\hat f(x, u)` and Jacobian :math:`\nabla_u \hat f(x, u)` of any dynamics model.

    The Jacobian is analytic where the model has a ``value_and_jacobian`` method. Otherwise the
    m unit tangents of the action are pushed forward through the model on the whole batch
    (forward-mode differentiation under ``vmap``), at the cost of about ``1 + m`` forward passes.
    Models with a layer that lacks forward mode (LSTM, fused attention) take ``n`` backward passes
    instead, with a warning. Threads may share a model; they take turns in forward mode.

    The model is checked once, at its first use, see :meth:`prepare`. Train mode is rejected if it
    makes a layer random or mixes the rows of a batch (dropout, batch norm).

    The model is referenced, never copied or registered as a submodule: in-place updates of its
    weights take effect at the next call, and it keeps its own device and train mode.

    Args:
        dynamics: a :class:`DynamicsModel`, a TensorDictModule that reads ``observation_key``
            and ``action_key``, or a function of the two tensors.
        observation_key: key under which a TensorDictModule reads the observation.
        action_key: key under which it reads the action.
        out_key: key of its prediction; needed if it has several output keys.
        predicts: whether it predicts the ``"change"`` of state or the ``"next_observation"``. If
            ``None``, the key that a TensorDictModule writes decides: a name with ``change``,
            ``delta`` or the like means the former; a key under ``"next"``, with ``next`` in its
            name, or equal to that of the observation means the latter; any other is rejected. A
            model without keys predicts the change.
        ensemble_dim: output dimension over which the mean is taken, for a module that returns one
            prediction per ensemble member.

    Raises:
        TypeError: if ``dynamics`` is none of the above.
        ValueError: if the options do not fit the model, or do not determine what it predicts.

    Examples:
        >>> jacobian = ActionJacobian(lambda x, u: 0.1 * x + u.square() @ torch.ones(1, 3))
        >>> value, matrix = jacobian.value_and_jacobian(torch.zeros(5, 3), torch.ones(5, 1))
        >>> matrix[0].squeeze(-1)
        tensor([2., 2., 2.])
    """

    def __init__(
        self,
        dynamics: DynamicsModel | TensorDictModuleBase | ChangeFunction,
        *,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        out_key: NestedKey | None = None,
        predicts: Predicts | None = None,
        ensemble_dim: int | None = None,
    ) -> None:
        if predicts not in (None, "change", "next_observation"):
            raise ValueError(f"predicts must be 'change' or 'next_observation', got {predicts!r}")
        if isinstance(dynamics, type):
            raise TypeError(
                f"dynamics is the class {dynamics.__name__}: give a model, {dynamics.__name__}(...)"
            )
        self.dynamics = dynamics
        self.ensemble_dim = ensemble_dim
        self.analytic = callable(getattr(dynamics, "value_and_jacobian", None))
        self._predict: ChangeFunction
        if isinstance(dynamics, DynamicsModel):
            if predicts == "next_observation" or ensemble_dim is not None or out_key is not None:
                raise ValueError(
                    f"{type(dynamics).__name__} has a mean_change method, which gives the mean "
                    "change of state: predicts, ensemble_dim and out_key do not apply to it"
                )
            self._predict = dynamics.mean_change
        elif self.analytic:
            raise TypeError(
                f"{type(dynamics).__name__} has value_and_jacobian but no mean_change(observation, "
                "action)"
            )
        elif isinstance(dynamics, TensorDictModuleBase):
            self._predict, predicts = read_module(
                dynamics, observation_key, action_key, out_key, predicts
            )
        elif callable(dynamics):
            if out_key is not None:
                raise ValueError("out_key applies to TensorDictModules only")
            self._predict = dynamics
        else:
            raise TypeError(
                "dynamics must have a mean_change(observation, action) method, be a "
                f"TensorDictModule or a callable, got {type(dynamics).__name__}"
            )
        self.predicts: Predicts = predicts or "change"
        self._mode: Mode | None = None
        self._lifted = False
        self._training: list[tuple[nn.Module, bool]] = []
        if not self.analytic:
            _load_forward_mode()

    @property
    def dtype(self) -> torch.dtype | None:
        """Type of the model's floating-point parameters; ``None`` if it has none."""
        if isinstance(self.dynamics, nn.Module):
            for parameter in self.dynamics.parameters():
                if parameter.is_floating_point():
                    return parameter.dtype
        return None

    def check_dimensions(self, observation_dim: int, action_dim: int) -> None:
        """Raise ``ValueError`` if the model declares widths other than these."""
        for name, width in (("observation_dim", observation_dim), ("action_dim", action_dim)):
            declared = getattr(self.dynamics, name, None)
            if isinstance(declared, int) and declared != width:
                raise ValueError(
                    f"{type(self.dynamics).__name__} has {name}={declared}, but the data have "
                    f"width {width}"
                )

    @property
    def ready(self) -> bool:
        """Whether the model has been checked and not changed mode since."""
        return self._mode is not None and all(x.training is mode for x, mode in self._training)

    def prepare(self, observation: Tensor, action: Tensor) -> None:
        """Check the model before its first use, and after ``train()`` and ``eval()``.

        One plain call gives lazy layers their weights. The model is then checked on these data: its
        prediction must be finite, of the right type and shape, the same at each call, independent
        of the other rows of the batch, and differentiable. The global random state stays untouched.
        A model that is :attr:`ready` is not checked again; a batch without rows shows nothing, so
        the check waits for the next one.

        Args:
            observation: ``(..., n)`` of a first step.
            action: ``(..., m)``.

        Raises:
            TypeError: if the prediction is not a tensor of the observation's type.
            ValueError: if the model fails one of these checks.
            RuntimeError: if it cannot be differentiated.
        """
        with FORWARD_MODE:
            if self.ready or observation.shape[:-1].numel() == 0:
                return
            training = [(layer, layer.training) for layer in watched(self.dynamics)]
            modes: dict[Mode, Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]]
            if self.analytic:
                modes = {"analytic": self._analytically}
                mode = probe(self.dynamics, self._first_analytic_value, modes, observation, action)
            else:
                self._lift(observation, action)
                modes = {"forward": self._forward_mode, "reverse": self._reverse_mode}
                mode = probe(self.dynamics, self._first_value, modes, observation, action)
            self._mode, self._training = mode, training

    def _lift(self, observation: Tensor, action: Tensor) -> None:
        """Find out whether the model requires a batch dimension, as batch norm does."""
        if observation.ndim > 1:
            return
        refuse_training(self.dynamics)
        with torch.no_grad(), torch.random.fork_rng([]):
            try:
                self._first_value(observation, action)
            except (RuntimeError, ValueError, IndexError):
                self._lifted = True
                try:
                    self._first_value(observation, action)
                except Exception:
                    self._lifted = False

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predicted change of state: ``(..., n)`` and ``(..., m)`` to ``(..., n)``."""
        if self._lifted and observation.ndim == 1:
            return self.value(observation.unsqueeze(0), action.unsqueeze(0)).squeeze(0)
        return self._change(self._predict(observation, action), observation, action)

    def _first_value(self, observation: Tensor, action: Tensor) -> Tensor:
        """:meth:`value`, with an error that names the model if it cannot be called."""
        if self._lifted and observation.ndim == 1:
            return self._first_value(observation.unsqueeze(0), action.unsqueeze(0)).squeeze(0)
        try:
            prediction = self._predict(observation, action)
        except Exception as error:  # a model made for something else may raise anything
            raise failure(self.dynamics, observation, action, error) from error
        return self._change(prediction, observation, action)

    def _first_analytic_value(self, observation: Tensor, action: Tensor) -> Tensor:
        try:
            return self._analytically(observation, action)[0]
        except RuntimeError as error:  # torch's, for example from a model of another type
            raise failure(self.dynamics, observation, action, error) from error

    def _change(self, prediction: Tensor, observation: Tensor, action: Tensor) -> Tensor:
        self._check_type(prediction, observation)
        if self.ensemble_dim is not None:
            prediction = prediction.mean(self.ensemble_dim)
        if prediction.shape != observation.shape:
            raise ValueError(
                f"the dynamics returned shape {tuple(prediction.shape)} for observations of shape "
                f"{tuple(observation.shape)} and actions of shape {tuple(action.shape)}; expected "
                "the observation's shape (for one prediction per ensemble member give "
                "ensemble_dim)"
            )
        return prediction - observation if self.predicts == "next_observation" else prediction

    def value_and_jacobian(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Predicted change ``(..., n)`` and its derivative by the action ``(..., n, m)``."""
        if self.analytic:
            return self._analytically(observation, action)
        if self._differentiates(observation, action) == "reverse":
            return self._reverse_mode(observation, action)
        return self._forward_mode(observation, action)

    def _check_type(self, returned: object, observation: Tensor) -> None:
        if not isinstance(returned, Tensor):
            raise TypeError(
                f"{describe(self.dynamics)} returned {type(returned).__name__}, expected a tensor "
                f"of {observation.dtype}"
            )
        if returned.dtype != observation.dtype:
            raise TypeError(
                f"{describe(self.dynamics)} returned {returned.dtype} for observations of "
                f"{observation.dtype}: let it return the observation's type"
            )

    def _analytically(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        value, jacobian = self.dynamics.value_and_jacobian(observation, action)  # type: ignore[union-attr]
        for returned in (value, jacobian):
            self._check_type(returned, observation)
        expected = (*observation.shape, action.shape[-1])
        if jacobian.shape != expected:
            raise ValueError(
                f"{type(self.dynamics).__name__}.value_and_jacobian returned a Jacobian of shape "
                f"{tuple(jacobian.shape)}, expected {expected}"
            )
        return value, jacobian

    def _differentiates(self, observation: Tensor, action: Tensor) -> Mode:
        if not _is_traced() and not self.ready:
            self.prepare(observation, action)
        return self._mode or "forward"

    __call__ = value_and_jacobian

    def taylor_remainder(self, observation: Tensor, u_bar: Tensor, action: Tensor) -> Tensor:
        r"""Error of the tangent at ``u_bar`` in predicting the change at ``action``: ``(..., n)``.

        This is :math:`\hat f(x, u) - \hat f(x, \bar u) - J(x, \bar u)(u - \bar u)`. It needs one
        product with the Jacobian, not the Jacobian itself.
        """
        analytic = getattr(self.dynamics, "taylor_remainder", None)
        if callable(analytic):
            return analytic(observation, u_bar, action)
        step = action - u_bar
        if self.analytic or self._differentiates(observation, u_bar) == "reverse":
            value, jacobian = self.value_and_jacobian(observation, u_bar)
            slope = (jacobian @ step.unsqueeze(-1)).squeeze(-1)
        else:
            value, slope = _pushed_forward(
                lambda: torch.func.jvp(lambda u: self.value(observation, u), (u_bar,), (step,))
            )
        return self.value(observation, action) - value - slope

    def residual_statistics(
        self, observation: Tensor, action: Tensor, source: str = "residuals"
    ) -> ResidualStatistics:
        """What the model knows of its one-step residuals.

        Args:
            observation: ``(..., n)``, raw units.
            action: ``(..., m)``, raw units.
            source: one of the values of :attr:`L1Config.covariance`.

        Returns:
            those from the model's ``residual_statistics`` or, without that method, the covariance
            from its ``residual_covariance``; without either, those of white residuals of unit
            variance.
        """
        known = getattr(self.dynamics, "residual_statistics", None)
        if callable(known):
            return known(observation, action, source)
        covariance = getattr(self.dynamics, "residual_covariance", None)
        if callable(covariance):
            return ResidualStatistics(covariance(observation, action))
        eye = torch.eye(observation.shape[-1], dtype=observation.dtype, device=observation.device)
        return ResidualStatistics(eye)

    @property
    def blockwise(self) -> bool:
        """Whether a batch may be evaluated in parts, which a model with an ``expansion`` allows."""
        return callable(getattr(self.dynamics, "expansion", None))

    def expansion(
        self, observation: Tensor, u_bar: Tensor, candidate: Tensor, tested: Tensor
    ) -> Expansion:
        """:meth:`taylor_remainder` at ``tested``, then the tangent at ``u_bar`` or ``candidate``.

        Returns:
            the error of the tangent at ``u_bar`` at ``tested`` ``(..., n)``, and a function that
            takes a mask ``(..., 1)``, true where the candidate is selected, and returns
            :meth:`value_and_jacobian` there.
        """
        if self.blockwise:
            return self.dynamics.expansion(observation, u_bar, candidate, tested)  # type: ignore[union-attr]

        if not self.analytic and self._differentiates(observation, u_bar) == "reverse":
            return self._reverse_expansion(observation, u_bar, candidate, tested)

        def at(moved: Tensor) -> tuple[Tensor, Tensor]:
            return self.value_and_jacobian(observation, torch.where(moved, candidate, u_bar))

        return self.taylor_remainder(observation, u_bar, tested), at

    def _reverse_expansion(
        self, observation: Tensor, u_bar: Tensor, candidate: Tensor, tested: Tensor
    ) -> Expansion:
        """:meth:`expansion` without a second Jacobian where no row moves."""
        value, jacobian = self._reverse_mode(observation, u_bar)
        slope = (jacobian @ (tested - u_bar).unsqueeze(-1)).squeeze(-1)

        def at(moved: Tensor) -> tuple[Tensor, Tensor]:
            if not _is_traced() and not bool(moved.any()):
                return value, jacobian
            return self._reverse_mode(observation, torch.where(moved, candidate, u_bar))

        return self.value(observation, tested) - value - slope, at

    def _forward_mode(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        def push_forward(tangent: Tensor) -> tuple[Tensor, ...]:
            return torch.func.jvp(
                lambda u: self.value(observation, u), (action,), (tangent.expand_as(action),)
            )

        basis = torch.eye(action.shape[-1], dtype=action.dtype, device=action.device)
        # The value does not depend on the tangent, so it is returned once, without a new dimension.
        # The same holds for the tangent's image where the action has no effect; torch cannot put
        # its dimension last. Inside a transform of the caller's, torch mistakes that one's
        # dimension for the tangent's.
        is_inner = _is_traced() and not torch.compiler.is_compiling()
        out_dims: Any = (0 if is_inner else None, 0)
        value, jacobian = _pushed_forward(
            lambda: torch.func.vmap(push_forward, out_dims=out_dims)(basis)
        )
        return value[0] if is_inner else value, jacobian.movedim(0, -1)

    def _reverse_mode(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Value and Jacobian, one backward pass per state; the rows of a batch are independent."""
        if _is_traced():
            value, pull_back, *_ = torch.func.vjp(lambda u: self.value(observation, u), action)
            basis = torch.eye(value.shape[-1], dtype=value.dtype, device=value.device)
            rows = [pull_back(row.expand_as(value))[0] for row in basis.unbind(0)]
            return value, torch.stack(rows, -2)
        # torch's function transforms do not support all layers that plain reverse mode does.
        with torch.inference_mode(False), torch.enable_grad():
            u = action.detach().clone().requires_grad_()
            value = self.value(observation.detach().clone(), u)
            last = value.shape[-1] - 1
            rows = [
                _gradient(value[..., i].sum(), u, retain_graph=i < last) for i in range(last + 1)
            ]
        return value.detach(), torch.stack(rows, -2)


def _gradient(output: Tensor, u: Tensor, *, retain_graph: bool) -> Tensor:
    if not output.requires_grad:
        return torch.zeros_like(u)
    (row,) = torch.autograd.grad(
        output, u, retain_graph=retain_graph, allow_unused=True, materialize_grads=True
    )
    return row


def _is_traced() -> bool:
    """Whether a compiler or one of torch's function transforms is tracing."""
    return torch.compiler.is_compiling() or torch._C._functorch.peek_interpreter_stack() is not None


def _pushed_forward(compute: Callable[[], Any]) -> tuple[Tensor, Tensor]:
    """Two results of forward mode, computed by one thread at a time."""
    if torch.compiler.is_compiling():  # when traced, no levels remain
        value, tangent = compute()
    else:
        with FORWARD_MODE:
            value, tangent = compute()
    return value, tangent


def _load_forward_mode() -> None:
    # The first jvp of a process loads torch's decompositions, which warn of deprecations in torch
    # itself. Do it here, where it can be silenced without hiding a warning of the model's own.
    with FORWARD_MODE, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.func.jvp(torch.sin, (torch.zeros(()),), (torch.ones(()),))
