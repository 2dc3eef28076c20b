"""Policies stored in files: how each kind is read and copied."""

from __future__ import annotations

import inspect
import json
import pickle
import warnings
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor, nn

from torchrl_l1.envs.references import require

NO_NORMALIZATION = "none"
"""Given instead of a file of VecNormalize to say that the one found is not to be used."""


class StableBaselinesPolicy(nn.Module):
    """The deterministic action of a policy of Stable-Baselines3, with its normalisation.

    Args:
        policy: ``model.policy``.
        statistics: mean, variance, epsilon and clipping of VecNormalize.
    """

    low: Tensor
    high: Tensor
    mean: Tensor | None
    deviation: Tensor | None

    def __init__(
        self, policy: Any, statistics: tuple[Tensor, Tensor, float, float] | None = None
    ) -> None:
        super().__init__()
        policy.set_training_mode(False)
        self.policy = policy
        self.squashed = bool(policy.squash_output)
        self.dtype = torch.float32
        space = policy.action_space
        self.register_buffer("low", torch.as_tensor(space.low))
        self.register_buffer("high", torch.as_tensor(space.high))
        mean, variance, epsilon, self.clip = statistics or (None, None, 0.0, 0.0)
        self.register_buffer("mean", mean)
        deviation = None if variance is None else (variance + epsilon).sqrt()
        self.register_buffer("deviation", deviation)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions ``(N, m)`` for raw observations ``(N, n)``."""
        if self.mean is not None and self.deviation is not None:
            scaled = (observation - self.mean) / self.deviation
            observation = scaled.clamp(-self.clip, self.clip)
        action = self.policy._predict(observation.to(self.dtype), deterministic=True)
        if self.squashed:
            return self.low + 0.5 * (action + 1.0) * (self.high - self.low)
        return torch.maximum(torch.minimum(action, self.high), self.low)


def _torchscript(file: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's notice that TorchScript is deprecated
        return torch.jit.load(str(file), map_location="cpu").eval()


def _onnx(file: Path) -> Any:
    runtime = require("onnxruntime", "onnx")
    session = runtime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    first = session.get_inputs()[0]
    kind = np.float64 if first.type == "tensor(double)" else np.float32
    batched = len(first.shape) > 1

    def act(observation: Tensor) -> Tensor:
        values = observation.detach().cpu().numpy().astype(kind)
        if batched and values.ndim == 1:
            return torch.as_tensor(session.run(None, {first.name: values[None]})[0])[0]
        return torch.as_tensor(session.run(None, {first.name: values})[0])

    return act


def _whole_onnx(file: Path) -> bytes:
    """A model together with the data that it keeps in other files."""
    content = file.read_bytes()
    if b"location" in content:  # the field that names other files
        content = require("onnx", "onnx").load(str(file)).SerializeToString()
    return content


def _stable_baselines(file: Path, normalization: str | None) -> StableBaselinesPolicy:
    require("stable_baselines3", "sb3")
    beside = _statistics(file)
    if normalization is None and beside is not None:
        raise ValueError(
            f"{beside} lies beside {file.name}: give it as normalization (--normalization "
            f"{beside}), which loads a pickle and so executes its contents, or say "
            f"{NO_NORMALIZATION!r} if the policy does not use it"
        )
    with zipfile.ZipFile(file) as archive:
        home = json.loads(archive.read("data"))["policy_class"]["__module__"]
    model = _algorithm(home).load(file, device="cpu")
    check_spaces(model.policy)
    stored = None
    if normalization not in (None, NO_NORMALIZATION):
        with open(str(normalization), "rb") as handle:
            stored = pickle.load(handle)
    return StableBaselinesPolicy(model.policy, moments(stored))


def _statistics(file: Path) -> Path | None:
    """A file named like those of VecNormalize, beside a model or in the folder of its name."""
    found = [
        one
        for folder in (file.parent, file.with_suffix(""))
        for one in folder.glob("*.pkl")
        if "vecnorm" in one.name.lower().replace("_", "").replace("-", "")
    ]
    # CheckpointCallback writes one for each of its models, with matching names.
    found.sort(key=lambda one: (one.stem.replace("vecnormalize_", "") != file.stem, one))
    return found[0] if found else None


def check_spaces(policy: Any) -> None:
    """Refuse a policy of Stable-Baselines3 whose spaces are not vectors, before it is used."""
    for what, space in (("reads", policy.observation_space), ("acts in", policy.action_space)):
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise ValueError(
                f"the policy {what} {space}: it must read and return vectors, each a Box of one "
                "dimension; wrap a policy that joins or splits them as a function of the "
                "observation"
            )


def moments(normalize: Any) -> tuple[Tensor, Tensor, float, float] | None:
    """Mean, variance, epsilon and clipping of VecNormalize, if it normalises observations."""
    if normalize is None or not normalize.norm_obs:
        return None
    return (
        torch.as_tensor(normalize.obs_rms.mean, dtype=torch.float64),
        torch.as_tensor(normalize.obs_rms.var, dtype=torch.float64),
        float(normalize.epsilon),
        float(normalize.clip_obs),
    )


def _algorithm(home: str) -> Any:
    """The class of the model, found through the module of its policy's class."""
    package, *inner = home.split(".")
    if package in ("stable_baselines3", "sb3_contrib") and inner[0] != "common":
        algorithms = import_module(f"{package}.{inner[0]}")
        return next(
            value
            for name, value in vars(algorithms).items()
            if name.lower() == inner[0].lower() and inspect.isclass(value)
        )
    # For algorithms with the common policies, the class makes no difference.
    return import_module("stable_baselines3").PPO


class FileKind(NamedTuple):
    """One kind of policy file.

    Attributes:
        read: reads the policy from a file, given the statistics for its observations, if any.
        is_code: whether reading it executes its contents.
        form: how its files are named.
        content: contents of a copy that needs no other file.
    """

    read: Callable[[Path, str | None], Any]
    is_code: bool
    form: str = "FILE"
    content: Callable[[Path], bytes] = Path.read_bytes


FILE_KINDS = {
    "sb3": FileKind(_stable_baselines, is_code=True, form="FILE.zip"),
    "torchscript": FileKind(lambda file, _: _torchscript(file), is_code=False),
    "onnx": FileKind(lambda file, _: _onnx(file), is_code=False, content=_whole_onnx),
}
"""Kinds of policy files by the word before the colon."""
