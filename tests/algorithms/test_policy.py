from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_l1.algorithms.policy import GaussianPolicy, clipped, make_actor


def test_distribution_is_the_gaussian_that_sample_draws_from() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (8,), std=0.3)
    observation = torch.randn(1, 3).expand(20_000, 3)
    loc, _ = policy(observation)
    drawn = policy.sample(observation)
    torch.testing.assert_close(drawn.mean(0), loc[0], atol=0.01, rtol=0)
    torch.testing.assert_close(drawn.std(0), torch.full((2,), 0.3), atol=0.01, rtol=0)
    data = TensorDict({"observation": observation}, batch_size=[20_000])
    expected = torch.distributions.Normal(loc, 0.3).log_prob(drawn).sum(-1)
    torch.testing.assert_close(make_actor(policy).get_dist(data).log_prob(drawn), expected)


def test_clipped_actor_respects_bounds_and_mean_action() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (8,), std=5.0)
    actor = clipped(make_actor(policy), torch.tensor([-1.0]), torch.tensor([1.0]))
    data = TensorDict({"observation": torch.randn(50, 3)}, batch_size=[50])
    with set_exploration_type(ExplorationType.RANDOM):
        action = actor(data)["action"]
    assert action.abs().max() == 1
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(actor(data)["action"], policy(data["observation"])[0])


def test_reset_std_touches_nothing_else() -> None:
    policy = GaussianPolicy(3, 2, (8,), std=0.3)
    before = [parameter.clone() for parameter in policy.mean.parameters()]
    policy.reset_std(2.0)
    torch.testing.assert_close(policy.log_std.exp(), torch.full((2,), 2.0))
    for old, new in zip(before, policy.mean.parameters(), strict=True):
        assert torch.equal(old, new)
    with pytest.raises(ValueError, match="positive"):
        policy.reset_std(0.0)


@pytest.mark.parametrize("hidden", [(), (8,), (16, 8)])
def test_sampler_draws_what_the_policy_does_and_does_not_follow_it(hidden: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(4, 2, hidden, std=0.5)
    observation = 3 + 2 * torch.randn(50, 4)
    policy.normalizer.fit(observation)
    sampler = policy.sampler()
    torch.manual_seed(1)
    expected = policy.sample(observation).detach()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(3)
    policy.normalizer.std.mul_(2)
    torch.manual_seed(1)
    found = sampler(observation)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    assert not found.requires_grad
