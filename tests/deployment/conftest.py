from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv

from torchrl_l1.deployment import RobustController, robustify, vector_environment
from torchrl_l1.dynamics import FitConfig

# A state feedback that balances the pendulum of the tasks.
GAIN = (1.0, 10.0, 1.0, 2.0)
OBSERVATION = torch.linspace(-0.1, 0.1, 12).reshape(3, 4)

POLICY_FILE = """
import torch

GAIN = torch.tensor([1.0, 10.0, 1.0, 2.0])


def balance(observation):
    return (observation @ GAIN).unsqueeze(-1)


def make():
    return balance


network = torch.nn.Linear(4, 1)


def make_env():
    from torchrl.envs import GymEnv

    return GymEnv("InvertedPendulum-v5")
"""


def balance(observation: torch.Tensor) -> torch.Tensor:
    return (observation @ torch.tensor(GAIN)).unsqueeze(-1)


def actions(policy, observation):
    data = TensorDict(observation=observation, batch_size=observation.shape[:-1])
    return policy(data)["action"]


@pytest.fixture(scope="module")
def env():
    return vector_environment(GymEnv("InvertedPendulum-v5"))


@pytest.fixture(scope="session")
def robust() -> RobustController:
    """The pendulum of the tasks with a linear policy, a small model and L1."""
    return robustify(
        "inverted_pendulum", balance, 1000, environments=10, progress=False,
        model={"hidden": [32], "members": 2},
        fit=FitConfig(max_epochs=80, batch_size=50, learning_rate=5e-3, patience=80),
    )  # fmt: skip


@pytest.fixture
def policy_file(tmp_path):
    file = tmp_path / "own_policy.py"
    file.write_text(POLICY_FILE)
    return file
