"""One step of the robust controller beside the paper's."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread, undisturbed_clock
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import ActionJacobian, L1Config, init
from torchrl_l1.control.affine import Step, make_step
from torchrl_l1.dynamics import EnsembleDynamics

SIZES = (1, 25, 256)
"""Numbers of environments."""

TASKS = {"inverted_pendulum": (4, 1), "half_cheetah": (17, 6)}
"""Observations n and actions m."""

MODES: dict[str, CompileMode] = {"eager": False, "compiled": "auto"}
HIDDEN = (200, 200, 200)
THREADS = 1
THREAD_COUNTS = (1, 2)


@torch.no_grad()
def run(repetitions: int, threads: tuple[int, ...]) -> list[Row]:
    """Measure both controllers.

    Args:
        repetitions: interleaved measurements of each variant.
        threads: numbers of threads of torch, one after the other.

    Returns:
        One row per number of threads, mode, task and number of environments: microseconds per step
        of either controller on the same model, state and observation, and their ``ratio``.
    """
    rows: list[Row] = []
    before = torch.get_num_threads()
    for count in threads:
        torch.set_num_threads(count)
        for mode, compile_step in MODES.items():
            for task, (n, m) in TASKS.items():
                for size in SIZES:
                    rows.append(
                        {
                            "threads": count,
                            "mode": mode,
                            "task": task,
                            "num_envs": size,
                            **_measure(n, m, size, compile_step, repetitions),
                        }
                    )
    torch.set_num_threads(before)
    return rows


def _measure(n: int, m: int, size: int, compile_step: CompileMode, repetitions: int) -> Row:
    torch.manual_seed(0)
    model = EnsembleDynamics(n, m, hidden=HIDDEN)
    x, u_rl = torch.randn(size, n), 2 * torch.rand(size, m) - 1
    cases: dict[str, Callable[[], Step]] = {}
    for name in ("paper", "robust"):
        make: Callable[..., L1Config] = getattr(L1Config, name)
        config = make(0.05, action_low=-1.0, action_high=1.0)
        step = make_step(config, ActionJacobian(model), compile_step)
        state = step(init([size], n, m, config), x, u_rl)[1]
        cases[name] = partial(step, state, x + 0.1, u_rl.flip(-1))
    seconds = interleave(cases, repetitions, clock=undisturbed_clock())
    row: Row = {}
    for name, values in seconds.items():
        row |= spread(name, [1e6 * value for value in values])
    return row | ratio("ratio", seconds["robust"], seconds["paper"])


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "l1_controllers",
        "The robust controller beside the paper's",
        "Microseconds per step, median (range), of all environments at once, with all diagnostics, "
        "for five members of 3 x 200 ReLU units.",
        run(repetitions, THREAD_COUNTS),
        {
            "threads": "threads",
            "mode": "mode",
            "task": "task",
            "num_envs": "environments",
            "paper": "paper",
            "robust": "robust",
            "ratio": "robust / paper",
        },
        dict.fromkeys(("paper", "robust"), ",.0f"),
    )
