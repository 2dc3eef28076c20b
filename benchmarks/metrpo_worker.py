"""Outer iterations of METRPO, one per line that comes in; runs in this version or in an older one.

Imports of this project are those of the version whose folder is first on the path.
"""

from __future__ import annotations

import json
import os
import sys
import time

import torch

from torchrl_l1.algorithms import METRPO, METRPOConfig


def algorithm(iterations: int, scale: float, precision: str | None) -> METRPO:
    """That of the recipe for HalfCheetah, the work of each phase times ``scale``."""
    config = METRPOConfig(outer_iterations=iterations, imagined_from_data=0.3, bootstrap=True)
    config.label = "executed"
    config.episode_steps = max(2, round(1000 * scale))
    config.trpo_iterations = max(1, round(40 * scale))
    config.imagined_horizon = 200
    config.model.hidden, config.model.activation = [200, 200, 200], "silu"
    config.fit.learning_rate, config.fit.batch_size = 0.004, 256
    config.fit.max_gradient_steps = max(1, round(1200 * scale))
    config.policy.std = 0.5
    config.trpo.max_kl, config.trpo.damping = 0.02, 0.01
    if precision is not None:
        config.precision = config.fit.precision = precision
    return METRPO("half_cheetah", config, horizon=config.episode_steps)


def main() -> None:
    """Start as the first line says, then answer each with the seconds of an outer iteration."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what else is printed, by whatever means, is no answer
    start = json.loads(sys.stdin.readline())
    torch.set_num_threads(start.pop("threads"))
    running = algorithm(**start)
    iterations = running.iterate()
    for _ in sys.stdin:
        before = time.process_time()
        result = next(iterations)
        seconds = {**result.seconds, "process": time.process_time() - before}
        print(json.dumps(seconds), file=answers, flush=True)


if __name__ == "__main__":
    main()
