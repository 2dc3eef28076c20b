from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_l1.algorithms.model_learning import ModelLearning
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig


def test_transitions_with_entries_that_are_not_finite_are_not_kept() -> None:
    learning = ModelLearning(EnsembleDynamics(1, 1, hidden=(4,)), FitConfig(), "nominal", 10)
    observation = torch.tensor([[[0.0], [1.0], [2.0]]])
    following = {
        "observation": observation + 1,
        "reward": torch.zeros(1, 3, 1),
        "non_finite": observation == 1,
    }
    parts = {"observation": observation, "action": observation, "executed": observation}
    learning.store(TensorDict({**parts, "next": following}, batch_size=[1, 3]))
    assert learning.buffer[:]["observation"].flatten().tolist() == [0.0, 2.0]
    assert learning.buffer[:]["next", "observation"].flatten().tolist() == [1.0, 3.0]
