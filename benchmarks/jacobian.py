"""Value and action Jacobian of an ensemble: the analytic pass against automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.func import jacfwd, jacrev, vmap

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.control import ActionJacobian
from torchrl_l1.dynamics import EnsembleDynamics

SIZES = ((1, 4, 1), (25, 4, 1), (6, 17, 6), (100, 17, 6))
"""Environments N, observations n, actions m."""

THREADS = 2
RIVALS = {"jvp": "`ActionJacobian`, generic", "jacfwd": "vmap(jacfwd)", "jacrev": "vmap(jacrev)"}

Pass = Callable[[], tuple[Tensor, Tensor]]


def _passes(model: EnsembleDynamics, x: Tensor, u: Tensor) -> dict[str, Pass]:
    """Rival computations of the mean change ``(N, n)`` and its Jacobian ``(N, n, m)``."""
    # A plain function hides the analytic pass: this is what any other model gets.
    generic = ActionJacobian(lambda x, u: model.mean_change(x, u), predicts="change")

    def with_value(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        change = model.mean_change(x, u)
        return change, change

    def by_jacfwd() -> tuple[Tensor, Tensor]:
        jacobian, change = vmap(jacfwd(with_value, argnums=1, has_aux=True))(x, u)
        return change, jacobian

    def by_jacrev() -> tuple[Tensor, Tensor]:
        jacobian, change = vmap(jacrev(with_value, argnums=1, has_aux=True))(x, u)
        return change, jacobian

    return {
        "analytic": lambda: model.value_and_jacobian(x, u),
        "jvp": lambda: generic.value_and_jacobian(x, u),
        "jacfwd": by_jacfwd,
        "jacrev": by_jacrev,
    }


def _check(passes: dict[str, Pass]) -> None:
    """Refuse to time computations that do not give the same numbers."""
    change, jacobian = passes["analytic"]()
    for name, rival in passes.items():
        other = rival()
        torch.testing.assert_close(other[0], change, rtol=1e-4, atol=1e-5, msg=name)
        torch.testing.assert_close(other[1], jacobian, rtol=1e-4, atol=1e-5, msg=name)


@torch.no_grad()
def run(repetitions: int) -> list[Row]:
    """Measure all sizes.

    Args:
        repetitions: interleaved measurements of each computation.

    Returns:
        One row per size: milliseconds of each computation, ``forwards`` (analytic pass over plain
        forward), and by rival the factor by which the analytic pass is faster.
    """
    rows: list[Row] = []
    for size, n, m in SIZES:
        torch.manual_seed(0)
        model = EnsembleDynamics(n, m, members=5, hidden=(200, 200), activation="tanh")
        x, u = torch.randn(size, n), torch.randn(size, m)
        passes = _passes(model, x, u)
        _check(passes)
        forward = partial(model.mean_change, x, u)
        seconds = interleave({"forward": forward, **passes}, repetitions)
        row: Row = {"N": size, "n": n, "m": m}
        for name, values in seconds.items():
            row |= spread(name, [1e3 * value for value in values])
        row |= ratio("forwards", seconds["analytic"], seconds["forward"])
        for name in RIVALS:
            row |= ratio(f"{name}_ratio", seconds[name], seconds["analytic"])
        rows.append(row)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    columns = {"N": "N", "n": "n", "m": "m", "forward": "forward", "analytic": "analytic"}
    columns |= RIVALS | {"forwards": "analytic / forward"}
    columns |= {f"{name}_ratio": f"{title} / analytic" for name, title in RIVALS.items()}
    return Table(
        "jacobian",
        "Value and action Jacobian",
        "Milliseconds per call, median (range), for N environments with n observations and m "
        "actions; five members of 2 x 200 tanh units.",
        run(repetitions),
        columns,
        {"forward": ".3f", "analytic": ".3f"} | {f"{name}_ratio": ".1f" for name in RIVALS},
    )
