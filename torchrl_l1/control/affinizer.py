"""The control-affine model as a TensorDictModule, for use without the adaptive law."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_l1.control.affine import affinize, operating_point
from torchrl_l1.control.layout import (
    Dynamics,
    as_action_jacobian,
    declared_dimension,
    required_entry,
)
from torchrl_l1.control.least_squares import is_finite
from torchrl_l1.control.module_model import Predicts

_STATE = ("u_bar", "started")


class Affinizer(TensorDictModuleBase):
    r"""Control-affine model ``x' = x + drift + jacobian @ u`` of learned dynamics.

    arXiv 2403.14860, affinization and switching law of section 3.2: the model is expanded to first
    order in the action around an operating input :math:`\bar u`. With a tolerance ``epsilon``, the
    operating input is kept from step to step and moves to the action where the expansion errs by
    more than that; the environment then needs the primer of :meth:`make_primer`. Without a
    tolerance, each sample is expanded around its own action, which suits stored data.

    It writes ``drift`` ``(..., n)`` and ``jacobian`` ``(..., n, m)`` under ``key``. With a
    tolerance it also writes ``switch`` and ``error`` ``(..., 1)`` there, and the next ``u_bar`` and
    ``started`` under ``("next", key)``.

    Args:
        dynamics: the learned model, see :class:`~torchrl_l1.control.ActionJacobian`.
        epsilon: tolerance in raw state units, or ``None`` to keep no operating input.
        observation_key: key of the observation.
        action_key: key of the action.
        key: name of the nested tensordict for these entries.
        action_dim: width of the action; :meth:`make_primer` needs it if the model has no attribute
            of that name.
        predicts: what ``dynamics`` predicts, ``"change"`` or ``"next_observation"``; ``None``
            decides as :class:`~torchrl_l1.control.ActionJacobian` does.

    Raises:
        KeyError: on a call, if the observation, the action or the stored operating input is
            missing.
        ValueError: if ``epsilon`` is negative.

    Examples:
        >>> affinizer = Affinizer(lambda x, u: 0.1 * u.sin().expand_as(x))
        >>> data = TensorDict(
        ...     observation=torch.zeros(5, 2), action=torch.zeros(5, 1), batch_size=[5]
        ... )
        >>> affinizer(data)["affine", "jacobian"].shape
        torch.Size([5, 2, 1])
    """

    def __init__(
        self,
        dynamics: Dynamics,
        epsilon: float | None = None,
        *,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        key: str = "affine",
        action_dim: int | None = None,
        predicts: Predicts | None = None,
    ) -> None:
        super().__init__()
        if epsilon is not None and not epsilon >= 0:
            raise ValueError(f"epsilon must not be negative, got {epsilon}")
        self.model = as_action_jacobian(dynamics, observation_key, action_key, predicts)
        self.epsilon = epsilon
        self.observation_key = observation_key
        self.action_key = action_key
        self.key = key
        self._action_dim = declared_dimension(self.model, "action_dim", action_dim)
        self.in_keys: list[NestedKey] = [observation_key, action_key]
        self.out_keys: list[NestedKey] = [(key, "drift"), (key, "jacobian")]
        if epsilon is not None:
            self.in_keys += [(key, name) for name in _STATE]
            self.out_keys += [(key, "switch"), (key, "error")]
            self.out_keys += [("next", key, name) for name in _STATE]

    def make_primer(self) -> TensorDictPrimer:
        """Transform that carries the operating input from step to step in the environment."""
        if self._action_dim is None:
            raise ValueError(
                "the primer needs the width of the action, and the model does not declare it: give "
                "Affinizer action_dim"
            )
        dtype = self.model.dtype or torch.get_default_dtype()
        spec = Composite(
            u_bar=Unbounded(shape=(self._action_dim,), dtype=dtype),
            started=Binary(shape=(1,), dtype=torch.bool),
        )
        return TensorDictPrimer(Composite({self.key: spec}), expand_specs=True)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the affine model at the tensordict's observation and action."""
        observation = required_entry(tensordict, self.observation_key, "Affinizer")
        action = required_entry(tensordict, self.action_key, "Affinizer")
        dtype = self.model.dtype or observation.dtype
        observation, action = observation.to(dtype), action.to(dtype)
        if self.epsilon is None:
            affinization = affinize(self.model, observation, action)
        else:
            u_bar, started = (self._memory(tensordict, name) for name in _STATE)
            u_bar = torch.where(started, u_bar, action)
            switch, error, affinization = operating_point(
                self.model, observation, u_bar, action, action, started, self.epsilon
            )
            tensordict.set((self.key, "switch"), switch)
            tensordict.set((self.key, "error"), torch.where(started, error, 0.0))
            following = TensorDict(
                u_bar=affinization.u_bar,
                started=is_finite(affinization.u_bar),
                batch_size=tensordict.batch_size,
                device=tensordict.device,
            )
            tensordict.set(("next", self.key), following)
        drift, jacobian = affinization.affine()
        tensordict.set((self.key, "drift"), drift)
        return tensordict.set((self.key, "jacobian"), jacobian)

    def _memory(self, tensordict: TensorDictBase, name: str) -> Tensor:
        value = tensordict.get((self.key, name), None)
        if value is None:
            raise KeyError(
                f"Affinizer found no {(self.key, name)}: append its primer to the environment, "
                "TransformedEnv(env, affinizer.make_primer()), or use epsilon=None"
            )
        return value
