"""The motion of particles compiled into one graph: a batched product of all members per layer."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from itertools import groupby
from types import FunctionType
from typing import Any, cast

import torch
from torch import Tensor

from torchrl_l1.compilation import CompileMode, check_mode, compiled
from torchrl_l1.dynamics.control_affine import affine_coefficients, affine_output
from torchrl_l1.dynamics.network import PlanningNetwork
from torchrl_l1.planning.particles import Draws, Predict, Propagation

_Group = tuple[int, int, int]


def resolve_compilation(
    mode: bool | str,
    device: torch.device | str = "cpu",
    propagation: str = "tsinf",
    name: str = "compile",
) -> bool:
    """Resolve ``"auto"`` to ``True`` on a GPU with a compiler, where many small calls cost most.

    On the CPU it becomes ``False``. The eager path passes a block of particles through a member's
    layers while they are in the cache; the compiled one passes all members through a layer
    together. In float32 that is slower; in bfloat16 it is somewhat faster, but compiling takes some
    ten seconds of every run.

    Args:
        mode: ``"auto"``, or the value to return.
        device: device on which plans are made.
        propagation: how particles travel. ``"ts1"`` runs eagerly, since the number of rows per
            member changes from step to step.
        name: name of the setting, for the error message.

    Raises:
        ValueError: for an unknown mode, or ``True`` with ``"ts1"``.
    """
    if check_mode(mode, name) is False:
        return False
    serves = propagation != "ts1"
    if mode is True:
        if not serves:
            raise ValueError(
                "propagation 'ts1' cannot be compiled, since members change rows at every step; "
                f"set {name} to False or 'auto', or propagation to 'tsinf' or 'mean'"
            )
        return True
    return serves and torch.device(device).type == "cuda" and _has_compiler()


def compiled_predictor(
    network: PlanningNetwork,
    propagation: Propagation,
    shares: list[int],
    draws: Draws,
    mode: CompileMode,
) -> Predict:
    """The compiled form of :func:`torchrl_l1.planning.particles.predictor`.

    Plans share a graph if their ensembles have the same shape and precision and they use the same
    shares and propagation, whatever the weights and the number of rows.

    Args:
        network: the members.
        propagation: ``"tsinf"`` or ``"mean"``.
        shares: particles of each member.
        draws: the noise.
        mode: ``"auto"`` warns if the compiler fails and runs the same operations one by one;
            ``True`` raises.
    """
    together = propagation == "mean"
    groups = ((0, network.members, 1),) if together else _groups(shares)
    parts = (*network.weights, network.bias)
    sizes = tuple((part.shape, part.dtype, part.device) for part in parts)
    point = network.standard_deviation is None
    change = _compiled((network.activation, point, groups, together, *sizes), mode)

    def predict(inputs: Tensor, step: int) -> Tensor:
        noise = None if together else draws.noise(step)
        for rows in (inputs, noise):
            if rows is not None:
                torch._dynamo.maybe_mark_dynamic(rows, 0)
        return change(network, groups, together, inputs, noise)

    return predict


# One for each kind of plan: torch keeps eight graphs of a function, then gives up.
@cache
def _compiled(kind: tuple[Any, ...], mode: CompileMode) -> Callable[..., Tensor]:
    notice = "plans continue without compilation, which failed"
    # The number of rows is marked as dynamic; all other sizes are fixed for the kind.
    return compiled(cast(FunctionType, _change), mode, dynamic=None, notice=notice)


def _groups(shares: list[int]) -> tuple[_Group, ...]:
    """First member, the one after the last, and particles of each, for runs of equal shares."""
    groups, first = [], 0
    for share, members in groupby(shares):
        last = first + len(list(members))
        groups.append((first, last, share))
        first = last
    return tuple(group for group in groups if group[2] > 0)


def _change(
    network: PlanningNetwork,
    groups: tuple[_Group, ...],
    together: bool,
    inputs: Tensor,
    noise: Tensor | None,
) -> Tensor:
    """Normalised change ``(B, n)`` from raw inputs ``(B, n + m)`` sorted by member."""
    if together:
        every = inputs.expand(network.members, -1, -1)
        return _raw(network, 0, network.members, every)[..., : network.observation_dim].mean(0)
    candidates = inputs.shape[0] // sum((last - first) * share for first, last, share in groups)
    rows = inputs.split([(last - first) * share * candidates for first, last, share in groups])
    raw = [
        _raw(network, first, last, part.unflatten(0, (last - first, -1))).flatten(0, 1)
        for (first, last, _), part in zip(groups, rows, strict=True)
    ]
    return network.sample(torch.cat(raw), noise)


def _raw(network: PlanningNetwork, first: int, last: int, inputs: Tensor) -> Tensor:
    """Raw outputs ``(k, R, out)`` of members from raw inputs ``(k, R, n + m)`` of each."""
    weight, *following = network.weights
    width = weight.shape[1]
    units = torch.baddbmm(network.bias[first:last, None], inputs[..., :width], weight[first:last])
    for weight in following:
        units = torch.bmm(network.activation(units).to(weight.dtype), weight[first:last])
    raw = units.float()
    if not network.affine_in_action:
        return raw
    return affine_output(*affine_coefficients(raw, network.action_dim), inputs[..., width:])


def _has_compiler() -> bool:
    # Triton writes the kernels, and a C compiler builds their launcher.
    compilers = (os.environ.get("CC"), "cc", "gcc", "clang")
    return find_spec("triton") is not None and any(map(shutil.which, filter(None, compilers)))
