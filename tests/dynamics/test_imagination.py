from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torchrl.envs.utils import check_env_specs
from torchrl.modules import CEMPlanner

from torchrl_l1.dynamics import EnsembleDynamics, EnsembleModelEnv, imagine

LOW, HIGH = torch.tensor([-1.0]), torch.tensor([1.0])


def drifting_model(box: float) -> EnsembleDynamics:
    """Each member adds the clipped action to the first state, exactly."""
    model = EnsembleDynamics(2, 1, members=3, hidden=())
    with torch.no_grad():
        model.network.weights[0].zero_()
        model.network.weights[0][:, 2, 0] = 1.0
    model.box.low.fill_(-box)
    model.box.high.fill_(box)
    return model


def reward(observation: Tensor, action: Tensor, successor: Tensor) -> Tensor:
    return observation[..., 0] + 10 * action[..., 0] + 100 * successor[..., 0]


def test_rollout_of_a_known_model() -> None:
    trajectories = imagine(
        drifting_model(100.0),
        lambda x: torch.full((3, 1), 5.0),
        reward,
        torch.zeros(3, 2),
        4,
        LOW,
        HIGH,
    )
    assert trajectories.batch_size == (3, 4)
    # The policy's sample is stored, the clipped one is acted on.
    assert (trajectories["action"] == 5).all()
    torch.testing.assert_close(trajectories["next", "observation"][0, :, 0], torch.arange(1.0, 5.0))
    expected = torch.tensor([0 + 10 + 100.0, 1 + 10 + 200.0, 2 + 10 + 300.0, 3 + 10 + 400.0])
    torch.testing.assert_close(trajectories["next", "reward"][0, :, 0], expected)
    assert trajectories["step"][0, :, 0].tolist() == [0, 1, 2, 3]
    assert trajectories["next", "done"][0, :, 0].tolist() == [False, False, False, True]
    assert not trajectories["next", "terminated"].any()
    assert trajectories["valid"].all()


def test_trajectories_end_where_they_leave_the_box() -> None:
    start = torch.tensor([[0.0, 0.0], [2.0, 0.0]])
    trajectories = imagine(
        drifting_model(2.5), lambda x: torch.ones(2, 1), reward, start, 4, LOW, HIGH
    )
    assert trajectories["valid"][..., 0].tolist() == [
        [True, True, True, False],
        [True, False, False, False],
    ]
    assert trajectories["next", "left_box"][0, :3, 0].tolist() == [False, False, True]
    assert not trajectories["next", "terminated"].any()
    assert trajectories["observation"].abs().max() <= 2.5


def test_trajectories_end_where_the_task_does() -> None:
    trajectories = imagine(
        drifting_model(2.5),
        lambda x: torch.ones(2, 1),
        reward,
        torch.tensor([[0.0, 0.0], [-2.4, 0.0]]),
        4,
        LOW,
        HIGH,
        lambda successor: successor[:, 0] >= 2,
    )
    # The first ends at 2, before it could leave the box; the second gets to 1.6.
    assert trajectories["valid"][..., 0].int().tolist() == [[1, 1, 0, 0], [1, 1, 1, 1]]
    assert trajectories["next", "terminated"][0, :2, 0].tolist() == [False, True]
    assert trajectories["next", "done"][0, :2, 0].tolist() == [False, True]
    assert not trajectories["next", "left_box"].any()


def test_model_as_environment() -> None:
    env = EnsembleModelEnv(
        drifting_model(2.5), reward, lambda count: torch.zeros(count, 2), -1.0, 1.0, (4,)
    )
    check_env_specs(env)
    rollout = env.rollout(10, lambda td: td.set("action", torch.ones(4, 1)))
    assert rollout.shape == (4, 3)
    assert rollout["next", "terminated"][:, -1].all()
    torch.testing.assert_close(rollout["next", "reward"][0, :2, 0], torch.tensor([110.0, 211.0]))


def test_random_member_propagation_uses_single_members() -> None:
    torch.manual_seed(0)
    model = drifting_model(1e6)
    with torch.no_grad():
        model.network.weights[0][:, 2, 0] = torch.tensor([1.0, 10.0, 100.0])
    env = EnsembleModelEnv(
        model, reward, lambda count: torch.zeros(count, 2), -1.0, 1.0, (2,), "random_member"
    )
    rollout = env.rollout(30, lambda td: td.set("action", torch.ones(2, 1)))
    steps = (rollout["next", "observation"] - rollout["observation"])[0, :, 0]
    assert set(steps.round().int().tolist()) == {1, 10, 100}
    with pytest.raises(ValueError, match="propagation"):
        EnsembleModelEnv(model, reward, lambda c: torch.zeros(c, 2), -1.0, 1.0, (), "both")


@pytest.mark.parametrize("propagation", ["mean", "random_member"])
def test_model_as_environment_without_batch_dimensions(propagation: str) -> None:
    env = EnsembleModelEnv(
        drifting_model(2.5), reward, lambda n: torch.zeros(n, 2), -1.0, 1.0, (), propagation
    )
    check_env_specs(env)
    rollout = env.rollout(10, lambda td: td.set("action", torch.ones(1)))
    assert rollout["next", "observation"][:2, 0].tolist() == [1.0, 2.0]
    assert rollout.shape == (3,)


def test_torchrl_planner_accepts_the_model() -> None:
    torch.manual_seed(0)
    env = EnsembleModelEnv(
        drifting_model(1e6),
        lambda x, u, successor: -(successor[..., 0] - 3).square(),
        lambda count: torch.zeros(count, 2),
        -1.0,
        1.0,
    )
    planner = CEMPlanner(env, planning_horizon=3, optim_steps=4, num_candidates=64, top_k=8)
    assert planner(env.reset())["action"].item() > 0.5
