"""Fine-fine_tuning by PPO."""

from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_l1.algorithms.fine_tuning import FineTuning, exploring
from torchrl_l1.algorithms.mbmf_config import FineTuningConfig
from torchrl_l1.algorithms.policy import GaussianPolicy
from torchrl_l1.envs import get_task

TASK = get_task("inverted_pendulum")


def make(**changes: object) -> tuple[GaussianPolicy, FineTuning]:
    torch.manual_seed(0)
    policy = GaussianPolicy(TASK.observation_dim, TASK.action_dim, [16], std=0.5)
    return policy, FineTuning(policy, FineTuningConfig(**changes))  # type: ignore[arg-type]


def episodes(policy: GaussianPolicy, target: float, count: int = 200) -> TensorDict:
    """Episodes of one step, with the reward highest at ``target``."""
    data = TensorDict({"observation": torch.randn(count, 1, TASK.observation_dim)}, [count, 1])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        exploring(policy, TASK)(data)
    ended = torch.ones(count, 1, 1, dtype=torch.bool)
    data["next"] = TensorDict(
        {
            "observation": torch.randn(count, 1, TASK.observation_dim),
            "reward": -(data["sampled"] - target).square(),
            "done": ended,
            "terminated": ended,
            "non_finite": torch.zeros_like(ended),
        },
        [count, 1],
    )
    return data


def test_explores_within_bounds_and_keeps_what_was_drawn() -> None:
    policy, _ = make()
    policy.reset_std(4.0)
    data = episodes(policy, 0.0)
    drawn = data["sampled"]
    assert torch.equal(data["action"], drawn.clamp(-3, 3))
    assert (drawn.abs() > 3).any()
    mean, std = policy(data["observation"])
    density = Normal(mean, std).log_prob(drawn).sum(-1)
    torch.testing.assert_close(data["sampled_log_prob"], density)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        exploring(policy, TASK)(data)
    torch.testing.assert_close(data["action"], mean.clamp(-3, 3))


def test_finds_the_action_of_highest_reward() -> None:
    policy, fine_tuning = make(learning_rate=6e-3, minibatches=4)
    for _ in range(9):
        report = fine_tuning.step(episodes(policy, 1.0))
    mean, _ = policy(torch.randn(100, TASK.observation_dim))
    assert mean.mean().item() == pytest.approx(1.0, abs=0.2)
    assert abs(report.kl) < 0.2


def test_values_approach_the_discounted_return() -> None:
    """Reward one for ever, in pieces of 20 steps: the value is 1 / (1 - gamma)."""
    policy, fine_tuning = make(discount=0.8, value_learning_rate=3e-2, epochs=1, minibatches=4)
    steps, going = 20, torch.zeros(8, 20, 1, dtype=torch.bool)
    for _ in range(6):
        observation = torch.randn(8, steps + 1, TASK.observation_dim)
        data = TensorDict({"observation": observation[:, :-1]}, [8, steps])
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            exploring(policy, TASK)(data)
        cut = going.clone()
        cut[:, -1] = True  # the end of the data, not of the task
        data["next"] = TensorDict(
            {
                "observation": observation[:, 1:],
                "reward": torch.ones(8, steps, 1),
                "done": cut,
                "terminated": going,
                "non_finite": going,
            },
            [8, steps],
        )
        fine_tuning.step(data)
    value = fine_tuning.value(torch.randn(200, TASK.observation_dim))
    assert value.mean().item() == pytest.approx(5.0, rel=0.1)


def test_nothing_follows_a_termination_in_the_middle_of_the_data() -> None:
    """Reward one per step, every fifth of which ends the task: the value counts what comes."""
    policy, fine_tuning = make(
        discount=1.0, gae_lambda=1.0, value_learning_rate=3e-2, epochs=1, minibatches=4
    )
    phase = torch.arange(20) % 5
    for _ in range(12):
        observation = torch.zeros(8, 20, TASK.observation_dim)
        observation[..., 0] = phase / 2 - 1
        data = TensorDict({"observation": observation}, [8, 20])
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            exploring(policy, TASK)(data)
        ended = (phase == 4).expand(8, 20)[..., None].clone()
        data["next"] = TensorDict(
            {
                "observation": observation.roll(-1, 1),
                "reward": torch.ones(8, 20, 1),
                "done": ended,
                "terminated": ended,
                "non_finite": torch.zeros_like(ended),
            },
            [8, 20],
        )
        fine_tuning.step(data)
    value = fine_tuning.value(data["observation"][0, :5])[:, 0]
    torch.testing.assert_close(
        value.detach(), torch.tensor([5.0, 4.0, 3.0, 2.0, 1.0]), atol=0.3, rtol=0
    )


def test_steps_that_did_not_happen_are_left_out() -> None:
    policy, fine_tuning = make(epochs=2, value_epochs=2)
    other, same = make(epochs=2, value_epochs=2)
    data = episodes(policy, 1.0, count=160)
    longer = torch.cat([data, data[:40]])
    longer["next", "reward"][160:] = 100.0
    longer["next", "non_finite"][160:] = True
    fine_tuning.advantage.average_gae = same.advantage.average_gae = False
    for agent, batch in ((fine_tuning, data.clone()), (same, longer)):
        torch.manual_seed(1)
        agent.step(batch)
    assert torch.equal(policy.mean[0].weight, other.mean[0].weight)


def test_annealing_ends_learning() -> None:
    policy, fine_tuning = make()
    before = [parameter.clone() for parameter in policy.parameters()]
    fine_tuning.step(episodes(policy, 1.0), progress=1.0)
    pairs = zip(before, policy.parameters(), strict=True)
    assert all(torch.equal(kept, parameter) for kept, parameter in pairs)


def test_each_network_learns_in_its_own_passes() -> None:
    policy, fine_tuning = make(epochs=1, value_epochs=5)
    other, same = make(epochs=1, value_epochs=1)
    data = episodes(policy, 1.0)
    for agent in (fine_tuning, same):
        torch.manual_seed(1)
        agent.step(data.clone())
    assert torch.equal(policy.mean[0].weight, other.mean[0].weight)
    assert not torch.equal(fine_tuning.value.network[0].weight, same.value.network[0].weight)


def test_rewards_that_are_not_finite_change_nothing() -> None:
    policy, fine_tuning = make()
    before = [parameter.clone() for parameter in policy.parameters()]
    data = episodes(policy, 1.0)
    data["next", "reward"][3] = torch.nan
    with pytest.raises(ValueError, match="non-finite advantages"):
        fine_tuning.step(data)
    pairs = zip(before, policy.parameters(), strict=True)
    assert all(torch.equal(kept, parameter) for kept, parameter in pairs)


def test_resumed_rounds_repeat_the_unbroken_ones() -> None:
    policy, fine_tuning = make(epochs=2, value_epochs=2)
    fine_tuning.step(episodes(policy, 1.0))
    copy, resumed = make(epochs=2, value_epochs=2)
    copy.load_state_dict(policy.state_dict())
    resumed.load_state_dict(deepcopy(fine_tuning.state_dict()))
    data = episodes(policy, 1.0)
    for agent in (fine_tuning, resumed):
        torch.manual_seed(1)
        agent.step(data.clone())
    for name, value in policy.state_dict().items():
        assert torch.equal(value, copy.state_dict()[name]), name


@pytest.mark.parametrize(("coefficient", "steps"), [(0.0, 0), (1.0, 6)])
def test_entropy_is_rewarded_as_asked(
    coefficient: float, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no action is better, only the spread grows: by the step size, as a slope of one has."""
    policy, fine_tuning = make(
        entropy_coefficient=coefficient, learning_rate=0.01, epochs=3, value_epochs=1, minibatches=2
    )
    weights = [part.clone() for part in policy.mean.parameters()]
    nothing = torch.zeros(200, 1, 1)
    monkeypatch.setattr(
        fine_tuning,
        "advantage",
        lambda data: data.update({"advantage": nothing, "value_target": nothing}),
    )
    fine_tuning.step(episodes(policy, 1.0))
    assert policy.log_std.item() == pytest.approx(math.log(0.5) + 0.01 * steps, abs=1e-5)
    pairs = zip(weights, policy.mean.parameters(), strict=True)
    assert all(torch.equal(before, part) for before, part in pairs)


def test_gradients_of_each_network_are_no_longer_than_allowed() -> None:
    policy, fine_tuning = make(max_gradient_norm=1e-3, epochs=2, value_epochs=2, minibatches=2)
    lengths = []
    for optimizer in fine_tuning.optimizers.values():
        optimizer.register_step_pre_hook(
            lambda optimizer, *_: lengths.append(
                math.hypot(*(p.grad.norm().item() for p in optimizer.param_groups[0]["params"]))
            )
        )
    data = episodes(policy, 1.0)
    data["next", "reward"] *= 1e6
    fine_tuning.step(data)
    assert len(lengths) == 8 and lengths == pytest.approx([1e-3] * 8, rel=1e-2)
