from __future__ import annotations

import numpy as np
import torch

from torchrl_l1.algorithms.collection import seed_streams, stream_seed


def test_streams_are_reproducible_and_distinct() -> None:
    names = [("initialisation",), ("iteration", 0), ("iteration", 1), ("collect", 1)]
    seeds = {stream_seed(run, *name) for run in range(50) for name in names}
    assert len(seeds) == 200
    assert all(0 <= seed < 2**63 for seed in seeds)
    # As of np.arange, or of a tensor, it is the same number.
    assert stream_seed(np.int64(3), "x") == stream_seed(torch.tensor(3), "x") == stream_seed(3, "x")


def test_seeding_restarts_torch() -> None:
    seed_streams(3, "iteration", 7)
    first = torch.randn(4)
    torch.randn(10)
    seed_streams(3, "iteration", 7)
    assert torch.equal(torch.randn(4), first)
