"""A model's predicted change of state and its derivative with respect to the action."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from torchrl_l1.control.state import ResidualStatistics

Predicts = Literal["change", "next_observation"]
ChangeFunction = Callable[[Tensor, Tensor], Tensor]
Expansion = tuple[Tensor, Callable[[Tensor], tuple[Tensor, Tensor]]]


@runtime_checkable
class DynamicsModel(Protocol):
    """What the L1 controller needs of a learned model.

    A model may also have ``value_and_jacobian(observation, action)``, which returns the same
    change ``(..., n)`` together with its derivative with respect to the action ``(..., n, m)``
    in raw units; it is then used in place of automatic differentiation. So is
    ``taylor_remainder(observation, u_bar, action)``, which returns what the tangent at ``u_bar``
    misses of the change at ``action`` ``(..., n)``, and ``expansion(observation, u_bar,
    candidate, tested)``, which joins the two, see :meth:`ActionJacobian.expansion`. The controller
    evaluates the latter in blocks of a batch's rows, each of which must depend on no other.
    """

    def mean_change(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predicted change of state: ``(..., n)`` and ``(..., m)`` to ``(..., n)``."""
        ...


class ActionJacobian:
    r"""Value :math:`\hat f(x, u)` and Jacobian :math:`\nabla_u \hat f(x, u)` of any dynamics model.

    The Jacobian is analytic where the model has a ``value_and_jacobian`` method. Otherwise the
    m unit tangents of the action are pushed forward through the model on the whole batch
    (forward-mode differentiation under ``vmap``), at the cost of about ``1 + m`` forward passes.

    The model is referred to, never copied nor registered as a submodule: weights updated in
    place are seen at the next call, and it keeps its own device and train mode.

    Args:
        dynamics: a :class:`DynamicsModel`, a TensorDictModule that reads ``observation_key``
            and ``action_key``, or a function of the two tensors.
        observation_key: key under which a TensorDictModule reads the observation.
        action_key: key under which it reads the action.
        out_key: key of its prediction; needed if it has several output keys.
        predicts: whether it predicts the ``"change"`` of state or the ``"next_observation"``. If
            ``None``, a TensorDictModule that writes ``("next", observation_key)`` or
            ``observation_key`` itself predicts the latter, any other model the former.
        ensemble_dim: dimension of its output over which the mean is taken, for a module that
            returns one prediction per ensemble member.

    Raises:
        TypeError: if ``dynamics`` is none of the above.
        ValueError: if the options do not fit the model.

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
            out_key = _prediction_key(dynamics, observation_key, action_key, out_key)
            self._predict = _on_tensors(dynamics, observation_key, action_key, out_key)
            if predicts is None and _is_observation(out_key, observation_key):
                predicts = "next_observation"
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
        if not self.analytic:
            _load_forward_mode()

    @property
    def dtype(self) -> torch.dtype | None:
        """Type of the model's floating-point parameters, ``None`` if it has none."""
        if isinstance(self.dynamics, nn.Module):
            for parameter in self.dynamics.parameters():
                if parameter.is_floating_point():
                    return parameter.dtype
        return None

    def check_dimensions(self, observation_dim: int, action_dim: int) -> None:
        """Raise ``ValueError`` if the model declares other widths than these."""
        for name, width in (("observation_dim", observation_dim), ("action_dim", action_dim)):
            declared = getattr(self.dynamics, name, None)
            if isinstance(declared, int) and declared != width:
                raise ValueError(
                    f"{type(self.dynamics).__name__} has {name}={declared}, but the data have "
                    f"width {width}"
                )

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predicted change of state: ``(..., n)`` and ``(..., m)`` to ``(..., n)``."""
        prediction = self._predict(observation, action)
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
        if not self.analytic:
            return self._forward_mode(observation, action)
        value, jacobian = self.dynamics.value_and_jacobian(observation, action)  # type: ignore[union-attr]
        expected = (*observation.shape, action.shape[-1])
        if jacobian.shape != expected:
            raise ValueError(
                f"{type(self.dynamics).__name__}.value_and_jacobian returned a Jacobian of shape "
                f"{tuple(jacobian.shape)}, expected {expected}"
            )
        return value, jacobian

    __call__ = value_and_jacobian

    def taylor_remainder(self, observation: Tensor, u_bar: Tensor, action: Tensor) -> Tensor:
        r"""What the tangent at ``u_bar`` misses of the change at ``action``: ``(..., n)``.

        This is :math:`\hat f(x, u) - \hat f(x, \bar u) - J(x, \bar u)(u - \bar u)`. It needs one
        product with the Jacobian and not the Jacobian.
        """
        analytic = getattr(self.dynamics, "taylor_remainder", None)
        if callable(analytic):
            return analytic(observation, u_bar, action)
        step = action - u_bar
        if self.analytic:
            value, jacobian = self.value_and_jacobian(observation, u_bar)
            slope = (jacobian @ step.unsqueeze(-1)).squeeze(-1)
        else:
            value, slope, *_ = torch.func.jvp(
                lambda u: self.value(observation, u), (u_bar,), (step,)
            )
        return self.value(observation, action) - value - slope

    def residual_statistics(
        self, observation: Tensor, action: Tensor, source: str = "residuals"
    ) -> ResidualStatistics:
        """What the model knows of its one-step residuals.

        Args:
            observation: ``(..., n)``, raw units.
            action: ``(..., m)``, raw units.
            source: one of :attr:`L1Config.covariance`'s.

        Returns:
            those of the model's ``residual_statistics``; else the covariance that its
            ``residual_covariance`` gives; else that of white residuals of unit variance.
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
        """Whether a batch may be evaluated in parts: the model has an ``expansion``."""
        return callable(getattr(self.dynamics, "expansion", None))

    def expansion(
        self, observation: Tensor, u_bar: Tensor, candidate: Tensor, tested: Tensor
    ) -> Expansion:
        """:meth:`taylor_remainder` at ``tested``, then the tangent at ``u_bar`` or ``candidate``.

        Returns:
            what the tangent at ``u_bar`` misses at ``tested`` ``(..., n)``, and a function of a
            mask ``(..., 1)``, true where the candidate is selected, that returns
            :meth:`value_and_jacobian` there.
        """
        if self.blockwise:
            return self.dynamics.expansion(observation, u_bar, candidate, tested)  # type: ignore[union-attr]

        def at(moved: Tensor) -> tuple[Tensor, Tensor]:
            return self.value_and_jacobian(observation, torch.where(moved, candidate, u_bar))

        return self.taylor_remainder(observation, u_bar, tested), at

    def _forward_mode(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        def push_forward(tangent: Tensor) -> tuple[Tensor, ...]:
            return torch.func.jvp(
                lambda u: self.value(observation, u), (action,), (tangent.expand_as(action),)
            )

        basis = torch.eye(action.shape[-1], dtype=action.dtype, device=action.device)
        # The value does not depend on the tangent: it comes out once, without a new dimension.
        out_dims: Any = (None, -1)
        value, jacobian = torch.func.vmap(push_forward, out_dims=out_dims)(basis)
        return value, jacobian


def _load_forward_mode() -> None:
    # The first jvp of a process loads torch's decompositions, which warn of torch's own
    # deprecations. Get that over with here, where it can be silenced without hiding anything
    # that the model itself may warn of.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.func.jvp(torch.sin, (torch.zeros(()),), (torch.ones(()),))


def _prediction_key(
    module: TensorDictModuleBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    out_key: NestedKey | None,
) -> NestedKey:
    unknown = [key for key in module.in_keys if key not in (observation_key, action_key)]
    if unknown or len(module.in_keys) != 2:
        raise ValueError(
            f"the dynamics module reads {module.in_keys}; it must read exactly "
            f"{observation_key!r} and {action_key!r} (see observation_key and action_key)"
        )
    if out_key is None:
        if len(module.out_keys) != 1:
            raise ValueError(
                f"the dynamics module writes {module.out_keys}: name its prediction with out_key"
            )
        return module.out_keys[0]
    if out_key not in module.out_keys:
        raise ValueError(f"the dynamics module writes {module.out_keys}, not out_key={out_key!r}")
    return out_key


def _is_observation(key: NestedKey, observation_key: NestedKey) -> bool:
    following = unravel_key(("next", observation_key))
    return unravel_key(key) in (unravel_key(observation_key), following)


def _on_tensors(
    module: TensorDictModuleBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    out_key: NestedKey,
) -> ChangeFunction:
    def predict(observation: Tensor, action: Tensor) -> Tensor:
        data = TensorDict({}, batch_size=observation.shape[:-1])
        data.set(observation_key, observation)
        data.set(action_key, action)
        return module(data).get(out_key)

    return predict
