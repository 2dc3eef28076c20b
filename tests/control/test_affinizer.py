from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import GymEnv, TransformedEnv

from torchrl_l1.control import Affinizer
from torchrl_l1.dynamics import EnsembleDynamics


def change(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return 0.1 * observation + action.square().expand_as(observation)


def sample(*batch: int) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, 3), action=torch.randn(*batch, 1), batch_size=batch
    )


def test_without_memory_each_sample_is_its_own_operating_point():
    data = sample(5)
    out = Affinizer(change)(data.clone())
    action = data["action"]
    torch.testing.assert_close(
        out["affine", "jacobian"], (2 * action).unsqueeze(-1).expand(5, 3, 1)
    )
    torch.testing.assert_close(out["affine", "drift"], 0.1 * data["observation"] - action.square())
    assert "next" not in out


def test_operating_point_is_remembered_until_the_tolerance_is_exceeded():
    affinizer = Affinizer(change, epsilon=0.5, action_dim=1)
    u_bar = torch.zeros(2, 1)
    data = TensorDict(
        observation=torch.zeros(2, 3),
        action=torch.tensor([[0.1], [1.0]]),
        affine=TensorDict(u_bar=u_bar, started=torch.ones(2, 1, dtype=torch.bool), batch_size=[2]),
        batch_size=[2],
    )
    out = affinizer(data)
    assert out["affine", "switch"].squeeze(-1).tolist() == [False, True]
    torch.testing.assert_close(
        out["affine", "error"].squeeze(-1), 3**0.5 * torch.tensor([0.01, 1.0])
    )
    torch.testing.assert_close(out["next", "affine", "u_bar"], torch.tensor([[0.0], [1.0]]))
    torch.testing.assert_close(out["affine", "jacobian"][:, 0, 0], torch.tensor([0.0, 2.0]))


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_a_first_action_that_is_not_finite_is_no_operating_point(wrong):
    affinizer = Affinizer(change, epsilon=0.5, action_dim=1)
    memory = affinizer.make_primer().primers["affine"].zero()
    gains = []
    for action in (wrong, 0.5, 0.5):
        data = TensorDict(observation=torch.zeros(3), action=torch.tensor([action]), affine=memory)
        out = affinizer(data)
        memory = out["next", "affine"]
        gains.append(out["affine", "jacobian"][0, 0].item())
    assert gains[1:] == [1.0, 1.0] and memory["started"].item()


def test_memory_lives_in_the_environment():
    model = EnsembleDynamics(3, 1, members=2, hidden=(8,))
    affinizer = Affinizer(model, epsilon=1e6)
    env = TransformedEnv(GymEnv("Pendulum-v1"), affinizer.make_primer())
    actor = TensorDictModule(lambda x: x[..., :1], ["observation"], ["action"])
    data = env.rollout(5, TensorDictSequential(actor, affinizer))
    first = data["action"][0]
    torch.testing.assert_close(data["next", "affine", "u_bar"], first.expand(5, 1))
    assert data["affine", "started"].squeeze(-1).tolist() == [False, True, True, True, True]


def test_missing_entries_and_bad_settings_are_named():
    with pytest.raises(KeyError, match="make_primer"):
        Affinizer(change, epsilon=0.5)(sample(2))
    with pytest.raises(KeyError, match="found no 'action'"):
        Affinizer(change)(sample(2).exclude("action"))
    with pytest.raises(ValueError, match="epsilon must not be negative"):
        Affinizer(change, epsilon=-1.0)
    with pytest.raises(ValueError, match="give Affinizer action_dim"):
        Affinizer(change, epsilon=1.0).make_primer()
