"""A TRPO step of METRPO's policy: derivatives in closed form against autograd's."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import torch
from tensordict import TensorDict

from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread, undisturbed_clock
from torchrl_l1.algorithms.policy import GaussianPolicy, make_actor
from torchrl_l1.objectives import TRPOConfig, TRPOReport, gaussian_trpo_step, trpo_step

THREADS = 1
SAMPLES = 50_000
HIDDEN = (32, 32)
OBSERVATIONS, ACTIONS = 17, 6
CONFIG = TRPOConfig(max_kl=0.02, damping=0.01)


def run(repetitions: int) -> list[Row]:
    """Measure both on the same samples, from the same policy each time.

    Args:
        repetitions: interleaved measurements of each.

    Returns:
        One row per implementation: ``milliseconds``, and of the closed form ``speedup``.
    """
    torch.manual_seed(0)
    policy = GaussianPolicy(OBSERVATIONS, ACTIONS, HIDDEN, std=0.5)
    observation = torch.randn(SAMPLES, OBSERVATIONS)
    action = policy.sample(observation).detach()
    advantage = action[:, :1] * observation[:, :1] + torch.randn(SAMPLES, 1)
    columns = {"observation": observation, "action": action, "advantage": advantage}
    data, actor = TensorDict(columns, batch_size=[SAMPLES]), make_actor(policy)
    start = deepcopy(policy.state_dict())

    def by_autograd() -> TRPOReport:
        policy.load_state_dict(start)
        return trpo_step(actor, data, CONFIG)

    def in_closed_form() -> TRPOReport:
        policy.load_state_dict(start)
        inputs = policy.normalizer.normalize(observation)
        return gaussian_trpo_step(policy.mean, policy.log_std, inputs, action, advantage, CONFIG)

    cases: dict[str, Callable[[], TRPOReport]] = {
        "autograd": by_autograd,
        "closed form": in_closed_form,
    }
    reports = [case() for case in cases.values()]
    # The same step, or there is nothing to compare.
    torch.testing.assert_close(reports[0].improvement, reports[1].improvement, rtol=1e-3, atol=0)
    seconds = interleave(cases, repetitions, shortest=0.0, clock=undisturbed_clock())
    rows: list[Row] = []
    for implementation, values in seconds.items():
        row: Row = {"implementation": implementation}
        row |= spread("milliseconds", [1e3 * value for value in values])
        if implementation != "autograd":
            row |= ratio("speedup", seconds["autograd"], values)
        rows.append(row)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "trpo",
        "A TRPO step",
        f"One step on {SAMPLES:,} samples, median (range), with a tanh policy of "
        f"{' x '.join(map(str, HIDDEN))} units for {OBSERVATIONS} observations and {ACTIONS} "
        "actions: `trpo_step`, which differentiates with autograd, and `gaussian_trpo_step`. "
        "Processor time with one thread, wall-clock time with more.",
        run(repetitions),
        {
            "implementation": "derivatives",
            "milliseconds": "milliseconds",
            "speedup": "times as fast as autograd",
        },
        {"milliseconds": ".1f"},
    )
