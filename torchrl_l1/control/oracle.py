"""The upper bound on what cancelling can achieve: a controller that knows the disturbance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import takewhile

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.transforms import (
    ActionScaling,
    Compose,
    DeviceCastTransform,
    DTypeCastTransform,
    RenameTransform,
    Transform,
)

from torchrl_l1.control.layout import L1_KEY, entry_name, required_entry
from torchrl_l1.control.pipeline import action_keys, check_alone, transforms_of


class OracleTransform(Transform):
    r"""A clairvoyant controller that takes the place of :class:`~torchrl_l1.control.L1Transform`.

    It looks up the matched disturbances before it in ``Compose``, or in a transformed environment
    inside, and sends the input that they turn back into the policy's action: the policy's action
    minus the matched disturbance, clipped once, at the end, to the actuators' limits. With
    disturbances :math:`d_1, \dots, d_k` in the order of ``Compose``, an input :math:`u` reaches the
    plant as :math:`d_1(\dots d_k(u))`, and the oracle sends

    .. math:: u = \mathrm{clip}\big(d_k^{-1}(\dots d_1^{-1}(\pi(x)))\big).

    No estimator can do better than this with the same policy: wherever the bounds allow it, the
    plant receives exactly what the policy asked for, from the first step on. The oracle does not
    account for noise, for disturbances that the input cannot reach, or for the quality of the
    policy: a policy that gains from a disturbance does worse with the oracle.

    The oracle treats a disturbance as matched if its transform has a method ``compensate(action)``
    without side effects. It must return the action which, sent through the transform at this step,
    makes the plant receive ``action``.

    No gradient flows through the oracle, nor through L1.

    As with ``L1Transform``, ``action`` stays the policy's, and ``("next", key, "u_exec")`` holds
    the executed input. The oracle replaces ``L1Transform``: it must come after the disturbances,
    and there must not be both.

    Args:
        action_key: key of the action.
        key: name of the nested tensordict with the executed input.

    Raises:
        ValueError: at a reset, if a transform that maps actions to other units stands between a
            disturbance and the oracle, if there is another controller, or if there are disturbances
            within the members of a ``SerialEnv``; environments in other processes are not checked.
        KeyError: at a step, if there is no action.
        RuntimeError: if used in a replay buffer.

    Examples:
        >>> import torch
        >>> from torchrl_l1.envs import make_env
        >>> env = make_env("inverted_pendulum", 2, actuator_bias=0.5, seed=0,
        ...                extra_transforms=[OracleTransform()])
        >>> data = env.rollout(3)
        >>> executed = (data["action"] - 0.5).clamp(-3.0, 3.0)
        >>> torch.equal(data["next", "l1", "u_exec"], executed)
        True
    """

    controls = True

    def __init__(self, action_key: NestedKey = "action", key: str = L1_KEY) -> None:
        super().__init__()
        self.action_key = unravel_key(action_key)
        self.key = entry_name(key, "OracleTransform")
        # Where the executed input waits, inside the tensordict, for the base environment to return.
        self._pending = f"_{key}_oracle_pending"

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the executed input."""
        action = self._action_spec()
        executed = Unbounded(shape=action.shape, dtype=action.dtype, device=action.device)
        shape = observation_spec.shape
        observation_spec[self.key] = Composite(u_exec=executed, shape=shape, device=action.device)
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rejected: the oracle acts at the steps of an environment, not on stored data.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(self._refusal())

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        executed = required_entry(tensordict, self.action_key, "OracleTransform")
        with torch.no_grad():
            for compensate in self._compensations():
                executed = compensate(executed)
            bounds = self._action_spec()
            if isinstance(bounds, Bounded):
                executed = executed.clamp(bounds.space.low, bounds.space.high)
        # The caller's tensordict keeps the policy's action: this one is a shallow copy.
        tensordict.set(self.action_key, executed)
        return tensordict.set(self._pending, executed)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        executed = tensordict.get(self._pending)
        stepped = tensordict.get("_step", None)
        if stepped is not None:
            before = tensordict.get((self.key, "u_exec"))
            executed = executed.where(stepped.reshape(*tensordict.batch_size, 1), before)
        return next_tensordict.set((self.key, "u_exec"), executed)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Partial resets are merged by the environment, which discards the rows not reset.
        list(self._compensations())
        self._check_surroundings()
        action = self._action_spec()
        extra = tensordict_reset.batch_size[: tensordict_reset.ndim - action.ndim + 1]
        nothing = torch.zeros(*extra, *action.shape, dtype=action.dtype, device=action.device)
        return tensordict_reset.set((self.key, "u_exec"), nothing)

    def _action_spec(self) -> TensorSpec:
        # In the units of what is sent from here, whatever later transforms make of them.
        self._environment()
        return self.parent.full_action_spec[self.action_key]

    def _environment(self) -> EnvBase:
        try:
            environment = self.container
        except ValueError:  # TorchRL's answer where the container is a replay buffer
            environment = None
        if environment is None:
            raise RuntimeError(self._refusal())
        return environment

    def _refusal(self) -> str:
        return (
            "OracleTransform acts inside an environment: append it to a TransformedEnv, not to a "
            "replay buffer. Stored data already hold the executed input, under "
            f"{('next', self.key, 'u_exec')}"
        )

    def _compensations(self) -> Iterator[Callable[[Tensor], Tensor]]:
        """The disturbances before this transform, in the order in which they are undone.

        An action meets the last transform first and the plant last, so the plant's input is traced
        back from the first transform, that of the innermost environment.
        """
        undone, before = "", self._before()
        keys = action_keys(before, self.action_key)
        for transform, key in zip(before, keys[1:], strict=True):
            compensate = getattr(transform, "compensate", None)
            if compensate is not None and _has_key(transform, "key", key):
                undone = type(transform).__name__
                yield compensate
            elif undone and _changes_units(transform, key):
                name = type(transform).__name__
                raise ValueError(
                    f"{name} stands between {undone} and OracleTransform, which would undo the one "
                    f"in the units of the other: put {name} after OracleTransform"
                )

    def _before(self) -> list[nn.Module]:
        """The transforms before this one, innermost environment first."""
        return list(takewhile(lambda one: one is not self, transforms_of(self._environment())))

    def _check_surroundings(self) -> None:
        environment = self._environment()
        check_alone(self, environment)
        while isinstance(environment, TransformedEnv):
            environment = environment.base_env
        members = environment.__dict__.get("_envs", []) if type(environment) is SerialEnv else []
        key, *_ = action_keys(self._before(), self.action_key)
        for transform in (inner for member in members for inner in transforms_of(member)):
            disturbs = callable(getattr(transform, "compensate", None))
            if disturbs and _has_key(transform, "key", key):
                name = type(transform).__name__
                raise ValueError(
                    f"{name} is within the members of a SerialEnv, where OracleTransform does not "
                    f"reach it: write TransformedEnv(SerialEnv(...), Compose({name}(...), "
                    "OracleTransform()))"
                )

    def __repr__(self) -> str:
        return f"{type(self).__name__}(key={self.key!r})"


def _has_key(transform: nn.Module, name: str, key: NestedKey) -> bool:
    return unravel_key(getattr(transform, name, key)) == key


def _changes_units(transform: nn.Module, key: NestedKey) -> bool:
    unchanged = Compose, DTypeCastTransform, DeviceCastTransform, RenameTransform
    if isinstance(transform, unchanged):
        return False
    keys = getattr(transform, "out_keys_inv", None) or ()
    return isinstance(transform, ActionScaling) or key in map(unravel_key, keys)
