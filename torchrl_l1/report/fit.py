"""Growth of a model's errors with the number of predicted steps."""

from __future__ import annotations

import math
from pathlib import Path

from torchrl_l1.dynamics import FitQuality
from torchrl_l1.report.style import color, grid, legend_below, save


def draw_fit_quality(quality: FitQuality, file: str | Path) -> Path:
    """Draw the errors of a model against the number of predicted steps, per entry.

    The dashed line is the spread of the entry: a model with a larger error predicts worse than the
    mean. Errors are on trajectories held out of training; the line ends where none is long enough
    or the model diverges.

    Args:
        quality: quality of the model, see ``EnsembleDynamics.quality``.
        file: the file to write, such as ``"quality.png"``.

    Returns:
        the file.
    """
    figure, axes = grid(len(quality.names), 3, 3.2, 2.4)
    for entry, axis in enumerate(axes):
        errors = {1: quality.rmse[entry]}
        errors |= {steps: values[entry] for steps, values in sorted(quality.open_loop.items())}
        known = {steps: error for steps, error in errors.items() if math.isfinite(error)}
        axis.plot(list(known), list(known.values()), "o-", color=color(1), label="error")
        axis.axhline(quality.spread[entry], color="0.4", ls="--", label="spread of the entry")
        axis.set_xscale("log")
        axis.set_yscale("log" if min([*known.values(), quality.spread[entry]]) > 0 else "linear")
        axis.set_xticks(list(errors), list(map(str, errors)), minor=False)
        axis.minorticks_off()
        unit = quality.units[entry]
        axis.set_title(f"{quality.names[entry]} ({unit})" if unit else quality.names[entry])
        axis.set_xlabel("steps predicted")
    legend_below(figure, axes)
    return save(figure, Path(file))
