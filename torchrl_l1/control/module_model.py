"""What a TensorDictModule predicts, as a function of two tensors."""

from __future__ import annotations

from typing import Literal

from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, set_interaction_type
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from torchrl_l1.control.probe import ChangeFunction

Predicts = Literal["change", "next_observation"]

_CHANGE = {"change", "changes", "delta", "deltas", "diff", "difference", "increment", "dx", "dobs"}
_NEXT = {"next", "following", "successor"}


def read_module(
    module: TensorDictModuleBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    out_key: NestedKey | None,
    predicts: Predicts | None,
) -> tuple[ChangeFunction, Predicts]:
    """What a module predicts from observation and action, and whether that is the change.

    Raises:
        ValueError: if the keys are not the module's, or do not determine what it predicts.
    """
    out_key = _prediction_key(module, observation_key, action_key, out_key)
    predict = _on_tensors(module, observation_key, action_key, out_key)
    return predict, predicts or _told_by(out_key, observation_key)


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
            f"{observation_key!r} and {action_key!r}: see observation_key and action_key; one with "
            "keys of its own is given to L1 as ActionJacobian(module, observation_key=...)"
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


def _told_by(out_key: NestedKey, observation_key: NestedKey) -> Predicts:
    """What a module predicts, according to the key that it writes."""
    path, observed = _path(out_key), _path(observation_key)
    if path in (observed, ("next", *observed)):
        return "next_observation"
    words = set(path[-1].lower().replace("-", "_").split("_"))
    if words & _CHANGE or path[-1].startswith("d_"):
        return "change"
    if path[0] == "next" or words & _NEXT:
        return "next_observation"
    raise ValueError(
        f"the dynamics module writes {out_key!r}, which does not show what it predicts: give "
        "predicts='change' or predicts='next_observation'"
    )


def _path(key: NestedKey) -> tuple[str, ...]:
    key = unravel_key(key)
    return (key,) if isinstance(key, str) else key


def _on_tensors(
    module: TensorDictModuleBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    out_key: NestedKey,
) -> ChangeFunction:
    # Its own default, whatever a collector sets for the policy.
    @set_interaction_type(None)
    def predict(observation: Tensor, action: Tensor) -> Tensor:
        data = TensorDict({}, batch_size=observation.shape[:-1])
        data.set(observation_key, observation)
        data.set(action_key, action)
        return module(data).get(out_key)

    return predict
