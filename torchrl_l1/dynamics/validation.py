"""Tests of a fitted model on transitions that it was not trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_l1.dynamics.model import EnsembleDynamics
from torchrl_l1.dynamics.quality import FitQuality, entry_names
from torchrl_l1.dynamics.transitions import Transitions

HORIZONS = (2, 5, 10, 20, 50)
"""Steps after which the open loop is compared with the plant."""

# Open loops from more starting points would not change the figures.
_MOST_STARTS = 500


@torch.no_grad()
def one_step_residuals(
    dynamics: EnsembleDynamics, data: TensorDictBase, chunk: int = 20_000
) -> Tensor:
    """Errors of the elites' mean on transitions ``[N]``: ``(N, n)``, state units.

    Args:
        dynamics: the model.
        data: with ``observation``, ``action`` and ``("next", "observation")``.
        chunk: rows evaluated at once.
    """
    return torch.cat(
        [
            part["next", "observation"]
            - part["observation"]
            - dynamics.mean_change(part["observation"], part["action"])
            for part in data.split(chunk)
        ]
    )


@torch.no_grad()
def measure_quality(
    dynamics: EnsembleDynamics,
    transitions: Transitions,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    horizons: Sequence[int] = HORIZONS,
) -> FitQuality:
    """The quality of a model on those transitions that were kept out of training.

    Args:
        dynamics: the model.
        transitions: see :func:`read_transitions`.
        names: names of the state's entries; ``x[0]``, ``x[1]`` and so on if ``None``.
        units: units of the same, equally many.
        horizons: steps after which the open loop is compared with the plant.

    Raises:
        ValueError: if there is not one name or unit per entry.
    """
    n = dynamics.observation_dim
    names, units = entry_names(n, names, units)
    held_out = transitions.data[transitions.validation]
    x, u = held_out["observation"], held_out["action"]
    change = held_out["next", "observation"] - x
    error = change - dynamics.mean_change(x, u)
    gains = member_gains(dynamics, x, u, transitions.data["action"].std(0, correction=0))
    # As the model sees it: the floor applies where an entry hardly moves.
    scale = dynamics.change_normalizer.std.double()
    total = change.double().var(0, correction=0)
    explained = 1 - error.double().square().mean(0) / total
    explained[total == 0] = math.nan
    return FitQuality(
        names=names,
        units=units,
        spread=_floats(x.double().std(0, correction=0)),
        change=_floats(total.sqrt()),
        rmse=_floats(_rms(error)),
        explained=_floats(explained),
        open_loop={h: _floats(open_loop_error(dynamics, transitions, h)) for h in horizons},
        gain_spread=_gain_spread(gains, scale),
        input_error=_floats(_rms(_as_input(gains.mean(0), error, scale))),
        training=int((~transitions.validation).sum()),
        validation=len(x),
        dropped=transitions.dropped,
    )


@torch.no_grad()
def open_loop_error(dynamics: EnsembleDynamics, transitions: Transitions, horizon: int) -> Tensor:
    """Root mean square error after ``horizon`` steps on the model's own predictions: ``(n,)``.

    From every row kept out of training that is followed by that many others, with the recorded
    actions. NaN if there is none, infinite if a prediction is not finite.
    """
    data, held_out = transitions.data, transitions.validation
    joined = (transitions.joined & held_out).long()
    joined[:-1] *= held_out[1:]
    # Number of consecutive links that begin at each row.
    ends = torch.cat([joined.new_zeros(1), joined.cumsum(0)])
    last = len(joined) - horizon + 1
    if last < 1:
        return data["observation"].new_full((dynamics.observation_dim,), math.nan)
    whole = ends[horizon - 1 : horizon - 1 + last] - ends[:last] == horizon - 1
    starts = (whole & held_out[:last]).nonzero().squeeze(-1)
    if not len(starts):
        return data["observation"].new_full((dynamics.observation_dim,), math.nan)
    starts = starts[:: math.ceil(len(starts) / _MOST_STARTS)]
    x = data["observation"][starts]
    for step in range(horizon):
        x = x + dynamics.mean_change(x, data["action"][starts + step])
    error = _rms(x - data["next", "observation"][starts + horizon - 1])
    return error.nan_to_num(nan=math.inf, posinf=math.inf)


def member_gains(dynamics: EnsembleDynamics, x: Tensor, u: Tensor, step: Tensor) -> Tensor:
    """Effect of the action on the state according to every elite: ``(k, N, n, m)``.

    By differences over a step ``(m,)`` of each entry of the action ``(N, m)`` in both directions:
    the data determine these, but not the slope in a point.
    """
    step = step.clamp_min(1e-6)
    sides = []
    for entry in range(len(step)):
        offset = torch.zeros_like(step)
        offset[entry] = step[entry]
        above, below = (dynamics.member_changes(x, u + side * offset) for side in (1, -1))
        sides.append((above - below)[dynamics.elites] / (2 * step[entry]))
    return torch.stack(sides, -1).double()


def _gain_spread(gains: Tensor, scale: Tensor) -> float:
    """Deviation of the members from their mean, with all entries of the state weighted alike."""
    if gains.shape[0] < 2:
        return math.nan
    gains = gains / scale[:, None]
    mean = gains.mean(0)
    apart = (gains - mean).square().sum((-1, -2)).mean()
    return float((apart / mean.square().sum((-1, -2)).mean()).sqrt())


def _as_input(gain: Tensor, error: Tensor, scale: Tensor) -> Tensor:
    """Inputs ``(N, m)`` that best explain errors ``(N, n)``, with equal weights for all entries."""
    matrix, right = gain / scale[:, None], (error.double() / scale)[..., None]
    square = matrix.mT @ matrix
    # An input without any effect explains nothing.
    ridge = 1e-9 * square.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-30)
    square = square + torch.diag_embed(ridge[:, None].expand(square.shape[:-1]))
    return torch.linalg.solve(square, matrix.mT @ right)[..., 0]


def _rms(error: Tensor) -> Tensor:
    return error.double().square().mean(0).sqrt()


def _floats(values: Tensor) -> tuple[float, ...]:
    return tuple(values.tolist())
