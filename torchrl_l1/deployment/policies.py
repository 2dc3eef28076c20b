"""Policies from files, functions and run directories, as TorchRL modules."""

from __future__ import annotations

import inspect
import pickle
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key_list
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase, TensorDictPrimer
from torchrl.modules.utils import get_primers_from_module

from torchrl_l1.control import L1Controller
from torchrl_l1.deployment.policy_files import (
    FILE_KINDS,
    StableBaselinesPolicy,
    check_spaces,
    moments,
)
from torchrl_l1.envs import load_attribute
from torchrl_l1.experiment.checkpoints import kept_by
from torchrl_l1.experiment.evaluate import load_run

Policy: TypeAlias = str | TensorDictModuleBase | nn.Module | Callable[[Tensor], Any]
"""A source, a TorchRL module, a model of Stable-Baselines3, or a function of the observation."""

FORMS = ", ".join(
    [
        *(f"{name}:{kind.form}" for name, kind in FILE_KINDS.items()),
        *("MODULE:NAME", "FILE.py:NAME", "or a run directory"),
    ]
)
"""The kinds of sources, in words."""


class FunctionPolicy(TensorDictModuleBase):
    """A policy that is a function of the observation, as a TorchRL module.

    It reads ``observation`` and writes ``action``, for batches or single observations. Two
    observations near zero show what the function takes: tensors or else NumPy arrays, and batches
    if it treats them like each observation by itself.

    Args:
        function: from an observation ``(n,)``, or several ``(N, n)``, to actions as a tensor, an
            array or numbers. Modules receive their own dtype and stay in train or evaluation mode
            as they are.
        observation: spec of the observation, with last dimension n.
        action: spec of the action, which sets shape, dtype and bounds.
        rows: whether the function takes one observation at a time; detected if ``None``.

    Attributes:
        rows: whether it is called for each observation by itself.
        arrays: whether it is called with arrays.

    Warns:
        UserWarning: if the function gives a different action when called again with the same
            observation.

    Raises:
        ValueError: if the function returns no action.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> env = GymEnv("Pendulum-v1")
        >>> policy = FunctionPolicy(
        ...     lambda x: [-2.0 * x[1]], env.observation_spec["observation"], env.action_spec
        ... )
        >>> data = TensorDict(observation=torch.ones(5, 3), batch_size=[5])
        >>> policy(data)["action"].shape
        torch.Size([5, 1])
    """

    in_keys = ["observation"]  # noqa: RUF012
    out_keys = ["action"]  # noqa: RUF012

    def __init__(
        self,
        function: Callable[[Tensor], Any],
        observation: TensorSpec,
        action: TensorSpec,
        rows: bool | None = None,
    ) -> None:
        super().__init__()
        self.function = function
        self.width = action.shape[-1]
        self.dtype = action.dtype
        bounds = action.space if isinstance(action, Bounded) else None
        for name, side in (("low", "low"), ("high", "high")):
            value = None if bounds is None else getattr(bounds, side).reshape(-1, self.width)[0]
            self.register_buffer(name, value)
        self.rows, self.arrays = bool(rows), False
        self._find_out(observation.shape[-1], (False, True) if rows is None else (rows,))

    @torch.no_grad()
    def _find_out(self, n: int, forms: Sequence[bool]) -> None:
        probe = torch.linspace(-0.1, 0.1, 2 * n).reshape(2, n)
        causes: list[str] = []
        # NumPy functions accept tensors, with a deprecation warning: give them arrays instead.
        for self.arrays, strict in ((False, True), (True, True), (False, False)):
            with warnings.catch_warnings():
                if strict:
                    warnings.simplefilter("error", DeprecationWarning)
                found = {rows: self._tried(probe, rows, causes) for rows in forms}
                together, alone = found.get(False), found.get(True)
                # The shape may be right even if the function confuses rows and columns or takes a
                # mean over the batch.
                self.rows = together is None or not (alone is None or _close(together, alone))
                first = alone if self.rows else together
                if first is not None:
                    again = self._tried(probe, self.rows, causes)
                    break
        else:
            raise ValueError(f"the policy {causes[-1]}")
        if again is None or not _close(first, again):
            warnings.warn(
                "the policy gives a different action when called again with the same observation: "
                "results vary if it draws at random, and are wrong if it remembers earlier calls, "
                "which come from several environments in turn; a memory belongs in the "
                "tensordict: use a TorchRL module with make_tensordict_primer",
                stacklevel=4,
            )

    def _tried(self, probe: Tensor, rows: bool, causes: list[str]) -> Tensor | None:
        """Actions for two observations, or ``None`` and the cause."""
        n = probe.shape[-1]
        try:
            found = [self._call(one) for one in (probe if rows else [probe])]
        except Exception as error:  # a function that does not take this form may raise anything
            causes.append(f"failed at an observation of width {n}: {_short(error)}")
            return None
        if rows and all(action.numel() == self.width for action in found):
            return torch.stack([action.reshape(self.width) for action in found])
        if not rows and found[0].shape == (2, self.width):
            return found[0]
        causes.append(
            f"returned shape {tuple(found[0].shape)} for an observation of width {n}; expected an "
            f"action of width {self.width}"
        )
        return None

    def _call(self, observation: Tensor) -> Tensor:
        if isinstance(self.function, nn.Module):
            observation = observation.to(_number_type(self.function) or observation.dtype)
        # Copies: a function may change its argument, and return the same memory each time.
        observation = observation.clone()
        given: Any = observation.numpy() if self.arrays else observation
        found: Any = self.function(given)
        found = found[0] if isinstance(found, tuple) else found
        return torch.as_tensor(np.asarray(found) if isinstance(found, list) else found).clone()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, within its bounds."""
        return tensordict.set("action", self.act(tensordict.get("observation")))

    def act(self, observation: Tensor) -> Tensor:
        """Actions ``(..., m)`` for observations ``(..., n)``."""
        batch = observation.shape[:-1]
        flat = observation.reshape(-1, observation.shape[-1])
        if self.rows:
            found = torch.stack([self._call(row).reshape(self.width) for row in flat])
        else:
            found = self._call(flat)
        action = found.reshape(*batch, self.width).to(self.dtype)
        return action if self.low is None else action.clamp(self.low, self.high)


def _close(one: Tensor, other: Tensor) -> bool:
    return torch.allclose(one.double(), other.double(), 1e-4, 1e-5, equal_nan=True)


def _number_type(module: nn.Module) -> torch.dtype | None:
    kinds = (parameter.dtype for parameter in module.parameters())
    return next((kind for kind in kinds if kind.is_floating_point), None)


def load_policy(
    policy: Policy,
    env: EnvBase,
    normalization: str | None = None,
    weights: str | None = None,
    search_path: Sequence[str] = (),
) -> TensorDictModuleBase:
    """A policy as a TorchRL module that reads ``observation`` and writes ``action``.

    ==================== ===========================================================
    policy               what it is
    ==================== ===========================================================
    ``sb3:FILE.zip``     a model of Stable-Baselines3, its deterministic action
    ``torchscript:FILE`` a TorchScript module from observations to actions
    ``onnx:FILE``        an ONNX model, its first input and its first output
    ``MODULE:NAME``      or ``FILE.py:NAME``: a policy, or a function without
                         arguments that returns one
    a run directory      the policy of the run's last stage
    ==================== ===========================================================

    TorchRL modules, models of Stable-Baselines3 and functions of the observation are also accepted
    as objects. Files of Stable-Baselines3 contain pickles, which execute code when they are loaded:
    open only those that you trust.

    Args:
        policy: a source or an object.
        env: its environment, see :func:`~torchrl_l1.envs.vector_environment`.
        normalization: file with the statistics of VecNormalize, a pickle, or ``"none"``.
        weights: file with a state dict to load into the module; other pickled objects are refused.
        search_path: folders to search for ``FILE.py`` and ``MODULE`` before the working directory.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for weights that do not fit the module, a file that cannot be read, an unknown
            source, a file of VecNormalize beside the policy's that ``normalization`` does not
            mention, or a policy that returns no action.
    """
    if normalization is not None and not (isinstance(policy, str) and policy.startswith("sb3:")):
        raise ValueError("normalization belongs to policies of Stable-Baselines3, sb3:FILE.zip")
    found: Any = policy
    if isinstance(policy, str):
        found = _from_source(policy, normalization, search_path)
    predicts = getattr(found, "predict", None)
    if callable(predicts) and hasattr(getattr(found, "policy", None), "squash_output"):
        # A model of Stable-Baselines3 knows the normaliser that it was trained with.
        check_spaces(found.policy)
        found = StableBaselinesPolicy(
            found.policy, moments(getattr(found, "get_vec_normalize_env", lambda: None)())
        )
    if weights is not None:
        if not isinstance(found, nn.Module):
            raise ValueError(f"weights need a module, but the policy is a {type(found).__name__}")
        try:
            stored = torch.load(weights, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            raise ValueError(
                f"{weights} is not a state dict, or holds more than tensors, and loading it would "
                "execute its contents: save module.state_dict()"
            ) from None
        except (EOFError, RuntimeError, LookupError, TypeError, AttributeError) as error:
            # Reading a file that is not a pickle may raise any of these.
            raise ValueError(f"{weights} is not a state dict: {_short(error)}") from error
        try:
            found.load_state_dict(stored)
        except (RuntimeError, TypeError, AttributeError) as error:
            raise ValueError(f"{weights} does not fit the policy: {_short(error)}") from error
    if isinstance(found, nn.Module):
        _check_mode(found)
    if isinstance(found, TensorDictModuleBase):
        _check_keys(found, env)
        return found
    if not callable(found):
        raise ValueError(f"a {type(found).__name__} is not a policy; policies are {FORMS}")
    action = env.full_action_spec["action"]
    if isinstance(found, StableBaselinesPolicy):
        _warn_of_bounds(found, action)
    return FunctionPolicy(found, env.full_observation_spec["observation"], action)


def _check_mode(policy: nn.Module) -> None:
    """Refuse a policy in train mode with batch normalisation, and warn of one with dropout."""
    for name, layer in policy.named_modules():
        if not getattr(layer, "training", False):
            continue
        words = f"the policy is in train mode, in which its layer {name} ({type(layer).__name__})"
        if isinstance(layer, nn.modules.batchnorm._BatchNorm):
            raise ValueError(
                f"{words} mixes the environments of a batch and learns from them: call its eval()"
            )
        drops = isinstance(layer, nn.modules.dropout._DropoutNd) and layer.p > 0
        if drops and isinstance(policy, TensorDictModuleBase):
            warnings.warn(f"{words} draws at random: call its eval()", stacklevel=3)


def _check_keys(policy: TensorDictModuleBase, env: EnvBase) -> None:
    """Refuse a module that reads keys the environment does not have, or writes no action."""
    if any(isinstance(module, L1Controller) for module in policy.modules()):
        raise ValueError("the policy already has an L1Controller: give the actor without it")
    if "action" not in unravel_key_list(policy.out_keys):
        raise ValueError(
            f"the policy writes {list(policy.out_keys)} and no 'action': wrap it in a module that "
            "writes one, or rename its output"
        )
    primers = get_primers_from_module(policy, warn=False)
    specs = [env.full_observation_spec, env.full_state_spec]
    for primer in () if primers is None else primers.modules():
        specs += [primer.primers] if isinstance(primer, TensorDictPrimer) else []
    there = {"is_init"} | {key for spec in specs for key in spec.keys(True, True)}
    missing = [key for key in unravel_key_list(policy.in_keys) if key not in there]
    if missing:
        raise ValueError(
            f"the policy reads {missing}, which the environment does not have: it has "
            f"{sorted(map(str, env.full_observation_spec.keys(True, True)))}. Let the function "
            "that makes the environment add the transforms that the policy was trained with, or "
            "give the module other in_keys"
        )


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def is_run(source: str) -> bool:
    """Whether a policy's name is that of a run or a kept checkpoint: these may have any path."""
    kind, _, rest = source.partition(":")
    path = Path(source)
    of_run = path.is_dir() or (kept_by(path) is not None and path.is_file())
    return of_run and not (kind in FILE_KINDS and rest)


def _from_source(source: str, normalization: str | None, search_path: Sequence[str]) -> Any:
    kind, _, rest = source.partition(":")
    if kind in FILE_KINDS and rest:
        if not Path(rest).is_file():
            raise FileNotFoundError(f"there is no file {rest}")
        try:
            return FILE_KINDS[kind].read(Path(rest), normalization)
        except (ValueError, ImportError, FileNotFoundError):
            raise
        except Exception as error:  # reading a foreign file may raise anything
            raise ValueError(f"{rest} cannot be read as {kind}: {_short(error)}") from error
    if is_run(source):
        return list(load_run(source).algorithm.policies.values())[-1]
    if not rest:
        raise ValueError(f"unknown policy {source!r}; policies are {FORMS}")
    return _from_code(source, search_path)


def _from_code(source: str, search_path: Sequence[str]) -> Any:
    found = load_attribute(source, search_path)
    if isinstance(found, nn.Module) or not callable(found):
        return found
    try:
        needed = [
            parameter
            for parameter in inspect.signature(found).parameters.values()
            if parameter.default is parameter.empty
            and parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
        ]
    except ValueError:  # a built-in function
        return found
    return found if needed else found()


def _warn_of_bounds(policy: StableBaselinesPolicy, action: TensorSpec) -> None:
    """Warn if the bounds show that a policy acts in other units than the environment."""
    if not isinstance(action, Bounded) or policy.low.shape != action.shape[-1:]:
        return
    theirs = action.space.low, action.space.high
    ours = policy.low, policy.high
    pairs = zip(ours, theirs, strict=True)
    if not all(
        _close(own.expand_as(there), there) for own, there in pairs if there.isfinite().all()
    ):
        row = [side.reshape(-1, side.shape[-1])[0].tolist() for side in theirs]
        warnings.warn(
            f"the policy was trained with actions from {ours[0].tolist()} to {ours[1].tolist()}, "
            f"the environment takes {row[0]} to {row[1]}: if a wrapper such as RescaleAction was "
            "between them, let the function that makes the environment add it",
            stacklevel=3,
        )
