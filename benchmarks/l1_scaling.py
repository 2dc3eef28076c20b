"""One eager step of L1 from one environment to thousands: what it costs each of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.control import ActionJacobian, L1Config, augment, init
from torchrl_l1.control.affine import Step, make_step
from torchrl_l1.dynamics import EnsembleDynamics

SIZES = (1, 6, 25, 64, 256, 1024, 4096)
"""Numbers of environments."""

WIDTHS = (17, 6)
"""Observations n and actions m, those of HalfCheetah."""

HIDDEN = (256, 256)
THREADS = 2
THREAD_COUNTS = (1, 2)


class _Apart:
    """An ensemble without its ``expansion``: switching law and tangents are passes of their own."""

    def __init__(self, model: EnsembleDynamics) -> None:
        self.mean_change = model.mean_change
        self.value_and_jacobian = model.value_and_jacobian
        self.taylor_remainder = model.taylor_remainder


@torch.no_grad()
def run(repetitions: int, threads: tuple[int, ...]) -> list[Row]:
    """Measure all numbers of environments.

    Args:
        repetitions: interleaved measurements of each variant.
        threads: numbers of threads of torch, one after the other.

    Returns:
        One row per number of threads and environments: microseconds per environment and step with
        the model's passes ``apart``, in one pass over the ``whole`` batch and in one pass in
        ``blocks`` of rows, which is what the transform does; ``pass_ratio`` and ``block_ratio``
        are the gains of the second over the first and of the third over the second, ``ratio`` that
        of both.
    """
    n, m = WIDTHS
    torch.manual_seed(0)
    model = EnsembleDynamics(n, m, hidden=HIDDEN)
    config = L1Config(0.05, epsilon=3.0, action_low=-1.0, action_high=1.0)
    joined, apart = ActionJacobian(model), ActionJacobian(_Apart(model))
    in_blocks = make_step(config, joined, False)
    rows: list[Row] = []
    before = torch.get_num_threads()
    for count in threads:
        torch.set_num_threads(count)
        for size in SIZES:
            x, u_rl = torch.randn(size, n), 2 * torch.rand(size, m) - 1
            state = in_blocks(init([size], n, m), x, u_rl)[1]
            arguments = state, x + 0.1 * torch.randn_like(x), u_rl.flip(-1)
            cases: dict[str, Callable[[], Step]] = {
                "apart": partial(augment, config, apart, *arguments),
                "whole": partial(augment, config, joined, *arguments),
                "blocks": partial(in_blocks, *arguments),
            }
            executed = [case()[0] for case in cases.values()]
            for other in executed[1:]:
                torch.testing.assert_close(other, executed[0], rtol=1e-4, atol=1e-4)
            seconds = interleave(cases, repetitions)
            row: Row = {"threads": count, "num_envs": size}
            for name, values in seconds.items():
                row |= spread(name, [1e6 * value / size for value in values])
            row |= ratio("pass_ratio", seconds["apart"], seconds["whole"])
            row |= ratio("block_ratio", seconds["whole"], seconds["blocks"])
            row |= ratio("ratio", seconds["apart"], seconds["blocks"])
            rows.append(row)
    torch.set_num_threads(before)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "l1_scaling",
        "The L1 step from one environment to thousands",
        "Microseconds per environment of one eager step, median (range), for five members of "
        "2 x 256 ReLU units, 17 observations and 6 actions: with the switching law and the "
        "tangents as passes of their own, in one pass over the whole batch, and in one pass in "
        "blocks of rows, as `L1Transform` has it.",
        run(repetitions, THREAD_COUNTS),
        {
            "threads": "threads",
            "num_envs": "environments",
            "apart": "passes apart",
            "whole": "one pass",
            "blocks": "one pass, blocks",
            "pass_ratio": "apart / one pass",
            "block_ratio": "whole / blocks",
            "ratio": "apart / blocks",
        },
        dict.fromkeys(("apart", "whole", "blocks"), ",.0f"),
    )
