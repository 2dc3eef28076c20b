"""Fitted models as files: tensors and settings in one, in the safetensors format, no pickle."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from torchrl_l1.atomic import write_atomically
from torchrl_l1.dynamics.heads import DeterministicHead, GaussianHead, Head
from torchrl_l1.dynamics.quality import FitQuality

_FORMAT = "torchrl_l1.dynamics"
_VERSION = 1
_FORMS: dict[str, type[nn.Module]] = {}

Model = TypeVar("Model", bound=nn.Module)


def stored_as(form: str) -> Callable[[type[Model]], type[Model]]:
    """Decorator for a class of models, which files refer to by this name."""

    def enter(kind: type[Model]) -> type[Model]:
        _FORMS[form] = kind
        return kind

    return enter


def save_dynamics(dynamics: nn.Module, path: str | os.PathLike[str]) -> None:
    """Write a model to a file, see :meth:`EnsembleDynamics.save`."""
    from safetensors.torch import save

    tensors = {
        name: value.detach().cpu().contiguous() for name, value in dynamics.state_dict().items()
    }
    settings = json.dumps(_settings(dynamics))
    metadata = {
        "format": _FORMAT,
        "version": str(_VERSION),
        "settings": settings,
        "sha256": _digest(settings, tensors.items()),
    }
    write_atomically(Path(path), save(tensors, metadata))


def load_dynamics(path: str | os.PathLike[str], device: torch.device | str = "cpu") -> nn.Module:
    """Read a model from a file, see :meth:`EnsembleDynamics.load`."""
    from safetensors import SafetensorError, safe_open

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with safe_open(path, "pt", device=str(device)) as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(
            f"{path} is damaged, or not from EnsembleDynamics.save ({_line(error)}); the model "
            "of a run is torchrl_l1.deployment.load_target(RUN_DIR).model"
        ) from None
    if metadata.get("format") != _FORMAT:
        raise ValueError(f"{path} holds tensors, but EnsembleDynamics.save did not write it")
    if metadata.get("version") != str(_VERSION):
        raise ValueError(
            f"{path} has version {metadata.get('version')} of the format, this release reads "
            f"version {_VERSION}"
        )
    settings = metadata.get("settings", "")
    if metadata.get("sha256") != _digest(settings, tensors.items()):
        raise ValueError(f"{path} is damaged: its contents do not match its checksum")
    try:
        return _restored(json.loads(settings), tensors, torch.device(device))
    # An attacker may have fitted the checksum to the contents.
    except Exception as error:
        raise ValueError(f"{path} does not hold a model: {_line(error)}") from error


def _settings(dynamics: Any) -> dict[str, Any]:
    """Everything that :func:`_restored` needs besides the tensors."""
    forms = [name for name, kind in _FORMS.items() if type(dynamics) is kind]
    if not forms:
        raise TypeError(
            f"cannot save a {type(dynamics).__name__}: only EnsembleDynamics and "
            "ControlAffineDynamics; use torch.save with its state_dict()"
        )
    quality = dynamics.quality
    return {
        "form": forms[0],
        "observation_dim": dynamics.observation_dim,
        "action_dim": dynamics.action_dim,
        "members": dynamics.members,
        "hidden": [bias.shape[-1] for bias in dynamics.network.biases][:-1],
        "activation": dynamics.network.activation,
        "std_floor": dynamics.change_normalizer.std_floor,
        "box_margin": dynamics.box.margin,
        "head": _head_settings(dynamics.head),
        "quality": None if quality is None else asdict(quality),
    }


def _head_settings(head: Head) -> dict[str, Any]:
    if type(head) is DeterministicHead:
        return {"name": "deterministic"}
    if type(head) is GaussianHead:
        return {"name": "gaussian", "dim": head.dim, "bound_penalty": head.bound_penalty}
    raise TypeError(
        f"cannot save a model with the head {type(head).__name__}: only DeterministicHead and "
        "GaussianHead; use torch.save with its state_dict()"
    )


def _restored(
    settings: dict[str, Any], tensors: Mapping[str, Tensor], device: torch.device
) -> nn.Module:
    sizes = [settings["observation_dim"] + settings["action_dim"], *settings["hidden"]]
    weights = settings["members"] * sum(a * b for a, b in pairwise(sizes))
    # Before any memory is requested.
    largest = max(*sizes, weights, settings["members"], settings["head"].get("dim", 0))
    if largest > sum(value.numel() for value in tensors.values()):
        raise ValueError("its layers are larger than the file")
    kind, head, quality = (settings.pop(name) for name in ("form", "head", "quality"))
    gaussian = head.pop("name") == "gaussian"
    settings["head"] = GaussianHead(**head) if gaussian else DeterministicHead()
    # Weights are drawn but not used: the caller's random state stays as it is.
    with torch.random.fork_rng(devices=[]):
        dynamics: Any = _FORMS[kind](**settings)
    dynamics.to(device=device, dtype=tensors["change_normalizer.mean"].dtype)
    dynamics.load_state_dict(dict(tensors))
    if quality is not None:
        dynamics.quality = _quality(quality)
    restored: nn.Module = dynamics.eval()
    return restored


def _quality(stored: dict[str, Any]) -> FitQuality:
    """Undo JSON, which has lists for tuples and strings for the keys of dictionaries."""
    loops = {int(steps): tuple(errors) for steps, errors in stored.pop("open_loop").items()}
    plain: dict[str, Any] = {
        name: tuple(v) if isinstance(v, list) else v for name, v in stored.items()
    }
    return FitQuality(**plain, open_loop=loops)


def _digest(settings: str, tensors: Iterable[tuple[str, Tensor]]) -> str:
    digest = hashlib.sha256(settings.encode())
    for name, value in sorted(tensors):
        digest.update(name.encode())
        digest.update(value.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
