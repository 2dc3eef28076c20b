"""Replay of recorded controller traces through the L1 law."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchrl_l1.control import L1Config, init, law

_INPUTS = ("obs", "drift", "jac", "action", "switch", "dt", "bound")
_OUTPUTS = ("u", "sigma_m", "x_hat")


def verify_traces(path: str | Path) -> list[tuple[str, float]]:
    r"""Replay each trace of a reference controller and report the largest deviation from it.

    The file is a NumPy ``.npz`` whose keys are ``<a>/<b>/<field>``, one trace per prefix
    ``<a>/<b>``, with T steps of n observations and m actions:

    ========== ========= ==============================================================
    field      shape     meaning
    ========== ========= ==============================================================
    obs        (T, n)    observation x
    drift      (T, n)    affine model: x' = x + drift + jac u, in state units per step
    jac        (T, n, m)
    action     (T, m)    the policy's action
    switch     (T,)      the controller was restarted before this step
    dt         ()        sampling time in seconds
    bound      ()        actions are clipped to [-bound, bound]
    u          (T, m)    executed input
    sigma_m    (T, m)    matched estimate, action units
    x_hat      (T, n)    predicted observation after the step
    sigma_um   (T, n-m)  optional: unmatched estimate, state units per second, in any
                         orthonormal basis (its norm is compared)
    ========== ========= ==============================================================

    The replay runs in float64 with :meth:`L1Config.reference`.

    Args:
        path: the file.

    Returns:
        name and largest absolute error over all compared fields, for each trace.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not an ``.npz``, holds no trace, or a field's shape does not fit.
        KeyError: if a trace lacks a field.
    """
    traces = _load(Path(path))
    return [(name, _largest_error(name, trace)) for name, trace in traces.items()]


def _load(path: Path) -> dict[str, dict[str, np.ndarray]]:
    if not path.is_file():
        raise FileNotFoundError(f"no trace file at {path}")
    try:
        archive = np.load(path)
    # The errors of zipfile and NumPy for a damaged file have no common class.
    except Exception as error:
        raise ValueError(f"{path} is not a NumPy .npz file: {error}") from error
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise ValueError(f"{path} holds a single array; expected an .npz of traces")
    traces: dict[str, dict[str, np.ndarray]] = {}
    with archive:
        for key in archive.files:
            prefix, separator, field = key.rpartition("/")
            if separator and prefix.count("/") == 1:
                try:
                    # For a part that is not an array, NumPy returns bytes.
                    traces.setdefault(prefix, {})[field] = np.asarray(archive[key])
                except Exception as error:
                    raise ValueError(f"{path}: cannot read {key}: {error}") from error
        if not traces:
            raise ValueError(
                f"{path} holds no trace: expected keys <a>/<b>/<field>, found {archive.files[:8]}"
            )
    return traces


def _largest_error(name: str, trace: Mapping[str, np.ndarray]) -> float:
    fields = _checked(name, trace)
    config = L1Config.reference(
        float(trace["dt"]),
        action_low=-float(trace["bound"]),
        action_high=float(trace["bound"]),
    )
    obs, drift, jac, action = (fields[field] for field in ("obs", "drift", "jac", "action"))
    state = init([], obs.shape[-1], action.shape[-1], dtype=torch.float64)
    error = 0.0
    for t in range(len(obs)):
        restart = fields["switch"][t].reshape(1).bool()
        u, state, diagnostics = law.step(
            config, state, obs[t], action[t], drift[t], jac[t], restart
        )
        pairs = [
            (u, fields["u"][t]),
            (state.sigma_m, fields["sigma_m"][t]),
            (state.x_hat, fields["x_hat"][t]),
        ]
        if "sigma_um" in fields:
            pairs.append((diagnostics.unmatched, fields["sigma_um"][t].norm().reshape(1)))
        # A NaN deviation must not pass for a small one.
        error = max(
            error,
            *(float((ours - theirs).abs().max().nan_to_num(torch.inf)) for ours, theirs in pairs),
        )
    return error


def _checked(name: str, trace: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    missing = [field for field in (*_INPUTS, *_OUTPUTS) if field not in trace]
    if missing:
        raise KeyError(f"trace {name!r} lacks {missing}; it has {sorted(trace)}")
    if trace["obs"].ndim != 2 or trace["action"].ndim != 2:
        raise ValueError(
            f"trace {name!r}: obs has shape {trace['obs'].shape} and action "
            f"{trace['action'].shape}, expected (T, n) and (T, m)"
        )
    (steps, n), m = trace["obs"].shape, trace["action"].shape[-1]
    if steps == 0:
        raise ValueError(f"trace {name!r} has no steps")
    shapes: dict[str, tuple[int, ...]] = {
        "obs": (steps, n),
        "drift": (steps, n),
        "jac": (steps, n, m),
        "action": (steps, m),
        "switch": (steps,),
        "u": (steps, m),
        "sigma_m": (steps, m),
        "x_hat": (steps, n),
        "dt": (),
        "bound": (),
    }
    if "sigma_um" in trace:
        shapes["sigma_um"] = (steps, n - m)
    for field, shape in shapes.items():
        if trace[field].shape != shape:
            raise ValueError(
                f"trace {name!r}: {field} has shape {trace[field].shape}, expected {shape}"
            )
    try:
        return {field: torch.as_tensor(trace[field].astype(np.float64)) for field in shapes}
    except (TypeError, ValueError) as error:
        raise ValueError(f"trace {name!r} holds values that are not numbers: {error}") from error


def verify_command(path: str, tolerance: float) -> bool:
    """``torchrl-l1 verify``: print the largest error per trace; returns whether all are within."""
    results = verify_traces(path)
    width = max(len(name) for name, _ in results)
    for name, error in results:
        print(f"{name:<{width}}  {error:.3e}  {'ok' if error <= tolerance else 'TOO LARGE'}")
    failed = sum(not error <= tolerance for _, error in results)
    print(
        f"{len(results) - failed} of {len(results)} traces within {tolerance:g} "
        f"(largest error {max(error for _, error in results):.3e})"
    )
    return failed == 0
