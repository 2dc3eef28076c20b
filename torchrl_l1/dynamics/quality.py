"""How good a fitted model is, in the units of the plant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_l1.dynamics.model import EnsembleDynamics
from torchrl_l1.dynamics.transitions import Transitions

HORIZONS = (2, 5, 10, 20, 50)
"""Steps after which the open loop is compared with the plant."""

_SHOWN = (10, 50)

MOST_GAIN_SPREAD = 0.3
"""Disagreement on the gain above which L1 was found to be of no use, see ``docs/data.md``."""

# Open loops from more starting points would not change the figures.
_MOST_STARTS = 500


@dataclass(frozen=True)
class FitQuality:
    """What a model misses of transitions that it was not trained on, per entry of the state.

    Attributes:
        names: of the entries, n of them.
        units: theirs, empty where unknown.
        spread: standard deviation of the entry in the data, in its unit.
        change: standard deviation of its change in one step.
        rmse: root mean square error of the prediction of one step.
        explained: share of the variance of the change that the prediction explains: 1 is perfect,
            0 as good as the mean, NaN for an entry that never changes.
        open_loop: root mean square error after so many steps on the model's own predictions, with
            the actions that were recorded; NaN where no trajectory kept out of training is so
            long, infinite where the model diverges.
        gain_spread: how much the members of the ensemble disagree on what an action does to the
            state: root mean square of their deviation from the mean gain, as a share of it; NaN
            for a single member. L1 acts by this gain.
        input_error: root mean square of the input that would explain what the model misses, per
            entry of the action, in its unit: what L1 sees of the model's errors and of noise.
        training: transitions trained on.
        validation: transitions kept out of training.
        dropped: rows of the data that were no transitions.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    spread: tuple[float, ...]
    change: tuple[float, ...]
    rmse: tuple[float, ...]
    explained: tuple[float, ...]
    open_loop: dict[int, tuple[float, ...]]
    gain_spread: float
    input_error: tuple[float, ...]
    training: int
    validation: int
    dropped: int

    def __str__(self) -> str:
        """A table, one line per entry."""
        loops = {steps: self.open_loop[steps] for steps in _SHOWN if steps in self.open_loop}
        after = [f"after {steps} steps" for steps in loops]
        lines = [["entry", "unit", "spread", "change", "one step", "explained", *after]]
        for entry, name in enumerate(self.names):
            of_entry = (self.spread, self.change, self.rmse)
            errors = [_number(values[entry]) for values in (*of_entry, *loops.values())]
            explained = self.explained[entry]
            share = "constant" if math.isnan(explained) else f"{100 * explained:.2f} %"
            lines.append([name, self.units[entry] or "-", *errors[:3], share, *errors[3:]])
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        table = [
            "  ".join(
                cell.ljust(width) if column < 2 else cell.rjust(width)
                for column, (cell, width) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in lines
        ]
        dropped = f", {self.dropped} dropped" if self.dropped else ""
        head = (
            f"{self.training} transitions trained on, {self.validation} kept out of training"
            f"{dropped}"
        )
        notes = [
            "spread, change: standard deviations of the entry and of its change in one step; "
            "others: root mean square errors"
        ]
        notes += [
            f"no trajectory kept out of training has {steps} steps"
            for steps, errors in loops.items()
            if all(map(math.isnan, errors))
        ]
        inputs = ", ".join(map(_number, self.input_error))
        share = f"members differ by {100 * self.gain_spread:.1f} % in what the action does; "
        agreement = "" if math.isnan(self.gain_spread) else share
        notes.append(f"{agreement}errors and noise look like an input of {inputs}")
        return "\n".join([head, *table, *notes, *([self.warning] if self.warning else [])])

    @property
    def warning(self) -> str:
        """Why the model is too poor for L1 to be of use; empty if nothing says so."""
        if not self.gain_spread > MOST_GAIN_SPREAD:
            return ""
        return (
            "the model is too poor for L1: its members differ by "
            f"{100 * self.gain_spread:.0f} % (more than {100 * MOST_GAIN_SPREAD:.0f} %) in what "
            "the action does; record more data, with actions that vary on their own and not only "
            "with the state"
        )


@torch.no_grad()
def measure_quality(
    dynamics: EnsembleDynamics,
    transitions: Transitions,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    horizons: Sequence[int] = HORIZONS,
) -> FitQuality:
    """The quality of a model on what of the transitions was kept out of training.

    Args:
        dynamics: the model.
        transitions: see :func:`read_transitions`.
        names: of the entries of the state; ``x[0]``, ``x[1]`` and so on if ``None``.
        units: theirs, of the same number.
        horizons: steps after which the open loop is compared with the plant.

    Raises:
        ValueError: if names or units are not as many as the entries.
    """
    n = dynamics.observation_dim
    names, units = entry_names(n, names, units)
    held_out = transitions.data[transitions.validation]
    x, u = held_out["observation"], held_out["action"]
    change = held_out["next", "observation"] - x
    error = change - dynamics.mean_change(x, u)
    gains = member_gains(dynamics, x, u, transitions.data["action"].std(0, correction=0))
    # As large as the model takes it for: the floor counts where an entry hardly moves.
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

    From every row kept out of training that so many others follow, with the recorded actions. NaN
    without one, infinite where a prediction is not finite.
    """
    data, held_out = transitions.data, transitions.validation
    joined = (transitions.joined & held_out).long()
    joined[:-1] *= held_out[1:]
    # How many links in a row begin at each row.
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
    """What an action does to the state in the eyes of every elite: ``(k, N, n, m)``.

    By differences over a step ``(m,)`` of each entry of the action ``(N, m)`` either way: what
    the data tell of, as the slope in a point does not.
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
    """Deviation of the members from their mean, of which entries of the state weigh alike."""
    if gains.shape[0] < 2:
        return math.nan
    gains = gains / scale[:, None]
    mean = gains.mean(0)
    apart = (gains - mean).square().sum((-1, -2)).mean()
    return float((apart / mean.square().sum((-1, -2)).mean()).sqrt())


def _as_input(gain: Tensor, error: Tensor, scale: Tensor) -> Tensor:
    """Inputs ``(N, m)`` that come closest to errors ``(N, n)``, entries of the state alike."""
    matrix, right = gain / scale[:, None], (error.double() / scale)[..., None]
    square = matrix.mT @ matrix
    # An input without any effect explains nothing.
    ridge = 1e-9 * square.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-30)
    square = square + torch.diag_embed(ridge[:, None].expand(square.shape[:-1]))
    return torch.linalg.solve(square, matrix.mT @ right)[..., 0]


def entry_names(
    n: int, names: Sequence[str] | None, units: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of so many entries.

    Raises:
        ValueError: if there are more or fewer.
    """
    for option, given in (("names", names), ("units", units)):
        if given is not None and (isinstance(given, str) or len(given) != n):
            raise ValueError(
                f"{option} must hold one for each of the observation's {n} entries, got {given!r}"
            )
    plain = [f"x[{entry}]" for entry in range(n)]
    return tuple(names if names is not None else plain), tuple(units or [""] * n)


def _rms(error: Tensor) -> Tensor:
    return error.double().square().mean(0).sqrt()


def _floats(values: Tensor) -> tuple[float, ...]:
    return tuple(values.tolist())


def _number(value: float) -> str:
    if math.isnan(value):
        return "-"
    return "diverges" if math.isinf(value) else f"{value:.3g}"
