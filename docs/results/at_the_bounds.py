"""What the robust controller makes of actuators that push less at their bounds than they should.

    python docs/results/at_the_bounds.py RUN deadzone 0.2
    python docs/results/at_the_bounds.py RUN gain 0.6

A dead zone and a lower gain are disturbances that change sign with the action. Writes
`at_the_bounds/TASK_NAME.md` beside this file, for 8 episodes of the mean action from the resets of
the suite: the oracle, which undoes it at every step; the same a step late, or with a running mean
of what it would have added, which is what the best estimator could know; the robust controller; one
whose filter learns nothing from pushes inwards at the actuators' bounds, and one whose filter does
not expect a disturbance to end there. Beside the returns
the mean over an episode of the estimate, as that of the true disturbance: root mean square over
actuators and episodes.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_l1.algorithms import collection
from torchrl_l1.algorithms.collection import episode_returns
from torchrl_l1.control import L1Config, OracleTransform, kalman_law
from torchrl_l1.control.kalman import Posterior
from torchrl_l1.envs import action_bounds, get_task
from torchrl_l1.experiment.evaluate import TrainedRun, load_run, make_collection
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.report.page import markdown

EPISODES, SEED, SETTLED = 8, 0, 200
TIME_CONSTANTS = (0, 3, 10, 30, 100)
TRUE: dict[str, Callable[[Tensor, float], Tensor]] = {
    "deadzone": lambda u, width: u.sign() * (u.abs() - width).clamp(min=0) - u,
    "gain": lambda u, gain: (gain - 1) * u,
}
"""What a disturbance adds to an input."""


Disturbance = tuple[str, float]


class LateOracle(OracleTransform):
    """Adds a running mean of what the oracle would have added at the steps before."""

    share = 1.0

    def __init__(self) -> None:
        super().__init__()
        self._mean: Tensor | None = None

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict[self.action_key]
        wanted = action
        for compensate in self._compensations():
            wanted = compensate(wanted)
        now = wanted - action
        mean = torch.zeros_like(now) if self._mean is None else self._mean
        self._mean = mean + self.share * (now - mean)
        space = self._action_spec().space
        executed = (action + mean).clamp(space.low, space.high)
        tensordict.set(self.action_key, executed)
        return tensordict.set("_oracle_executed", executed)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set((self.key, "u_exec"), tensordict["_oracle_executed"])


class Unbounded(kalman_law.Reach):
    """All of a disturbance comes through, whatever the bounds of the action are."""

    @classmethod
    def of(cls, config: L1Config, executed: Tensor, posterior: Posterior) -> Unbounded:
        """As :meth:`Reach.of`."""
        mean = posterior.mean
        none = torch.zeros_like(mean)
        return cls(mean, ~none.bool(), none, none)


NOTHING_CONTRADICTS = (kalman_law, "CONTRADICTION", math.inf)
NOTHING_ENDS = (kalman_law, "Reach", Unbounded)
LATE = (collection, "OracleTransform", LateOracle)
"""What other controllers have in place of what is shipped: where, its name, and what."""


def row(trained: TrainedRun, disturbance: Disturbance, l1: str, name: str) -> dict[str, Any]:
    """One controller."""
    cell = {"policy": "deterministic", "disturbances": dict([disturbance])}
    data = make_collection(trained, Condition(l1, **cell), EPISODES).evaluate(SEED)
    returns = episode_returns(data)
    error = float(returns.std()) / EPISODES**0.5
    line = {"controller": name, "return": f"{float(returns.mean()):.0f} ± {error:.0f}"}
    if l1 == "robust":
        executed, estimate = (data["next", "l1", key] for key in ("u_exec", "sigma_m"))
        true = TRUE[disturbance[0]](executed, disturbance[1])
        for column, values in (("mean estimate", estimate), ("true mean", true)):
            line[column] = f"{float(values[:, SETTLED:].mean(1).square().mean().sqrt()):.2f}"
    print(line, [round(value) for value in returns.tolist()], flush=True)
    return line


@torch.no_grad()
def residuals(trained: TrainedRun, disturbance: Disturbance) -> str:
    """What the model misses of the motion without a controller, and how often inputs are bounds."""
    cell = {"policy": "deterministic", "disturbances": dict([disturbance])}
    data = make_collection(trained, Condition("off", **cell), EPISODES).evaluate(SEED).flatten()
    dynamics, (low, high) = trained.algorithm.dynamics, action_bounds(get_task(trained.recipe.task))
    observation, action = data["observation"], data["action"].clamp(low, high)
    true = TRUE[disturbance[0]](action, disturbance[1])
    change, jacobian = dynamics.value_and_jacobian(observation, action)
    missed = data["next", "observation"] - observation - change
    factor = torch.linalg.cholesky(dynamics.residuals.covariance)
    squares = [
        float(torch.linalg.solve_triangular(factor, each.mT, upper=False).square().mean())
        for each in (missed, missed - (jacobian @ true[..., None])[..., 0])
    ]
    bound = float((action.abs() >= 0.99 * high).float().mean())
    return (
        "Without a controller the mean square of the model's whitened residuals is "
        f"{squares[0]:.1f}, and {squares[1]:.2f} once the effect of the true disturbance is "
        f"subtracted; {bound:.0%} of the inputs are at their bounds."
    )


def main(path: str, name: str, value: str) -> None:
    """All of it."""
    trained, disturbance = load_run(path), (name, float(value))
    note = residuals(trained, disturbance)
    lines = [
        row(trained, disturbance, "off", "none"),
        row(trained, disturbance, "oracle", "oracle, at every step"),
        row(trained, disturbance, "robust", "robust"),
    ]
    with mock.patch.object(*NOTHING_CONTRADICTS):
        lines.append(row(trained, disturbance, "robust", "robust, no push at a bound counts"))
    with mock.patch.object(*NOTHING_ENDS):
        lines.append(row(trained, disturbance, "robust", "robust, nothing ends at the bounds"))
    for steps in TIME_CONSTANTS:
        LateOracle.share = 1 / (1 + steps)
        late = f"oracle, mean over {steps} steps before" if steps else "oracle, one step late"
        with mock.patch.object(*LATE):
            lines.append(row(trained, disturbance, "oracle", late))
    filled = [{"mean estimate": "", "true mean": "", **line} for line in lines]
    columns = ("controller", "return", "mean estimate", "true mean")
    table = markdown([{column: line[column] for column in columns} for line in filled])
    target = Path(__file__).with_suffix("") / f"{trained.recipe.task}_{name}.md"
    target.write_text(f"{table}\n\n{note}\n")
    print(f"Table: {target}")


if __name__ == "__main__":
    main(*sys.argv[1:])
