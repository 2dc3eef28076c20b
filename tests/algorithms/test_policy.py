from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_l1.algorithms.policy import GaussianActor, GaussianPolicy, acting, kinds_of, make_actor
from torchrl_l1.envs import get_task


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


def torchrl_actor(policy: GaussianPolicy) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        log_prob_key="log_prob",
    )


@pytest.mark.parametrize("kind", [kind for kind in ExplorationType if kind.value != "median"])
@pytest.mark.parametrize("shape", [(), (3,), (50,), (7, 5)])
def test_the_actor_writes_what_torchrls_own_writes(
    kind: ExplorationType, shape: tuple[int, ...]
) -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (8,), std=0.7)
    data = TensorDict({"observation": torch.randn(*shape, 3)}, batch_size=shape)
    written, states = [], []
    for actor in (torchrl_actor(policy), make_actor(policy, log_prob_key="log_prob")):
        torch.manual_seed(1)
        with set_exploration_type(kind):
            written.append(actor(data.clone()))
        states.append(torch.get_rng_state())
    expected, found = written
    assert list(found.keys()) == ["observation", "loc", "scale", "action", "log_prob"]
    for name, value in expected.items():
        assert torch.equal(found[name], value), name
    assert torch.equal(*states)


def test_without_an_exploration_type_and_with_another_target_torchrls_own_actor_acts() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (8,), std=5.0)
    actor = GaussianActor(policy, bounds=(-0.001, 0.001))
    data = TensorDict({"observation": torch.randn(50, 3)}, batch_size=[50])
    mean = policy(data["observation"])[0].clamp(-0.001, 0.001)
    assert torch.equal(actor(data.clone())["action"], mean)
    apart = actor(data, tensordict_out=TensorDict(batch_size=[50]))
    assert torch.equal(apart["action"], mean) and "action" not in data
    assert torch.equal(actor(observation=data["observation"])[-1], mean)
    with (
        set_exploration_type(ExplorationType.MEDIAN),
        pytest.raises(NotImplementedError, match="median"),
    ):
        actor(data)


def test_acting_respects_bounds_and_mean_action() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(4, 1, (8,), std=20.0)
    task = get_task("inverted_pendulum")
    actor, free = acting(policy, task), acting(policy, task, clip=False)
    data = TensorDict({"observation": torch.randn(50, 4)}, batch_size=[50])
    with set_exploration_type(ExplorationType.RANDOM):
        action = actor(data)["action"]
        assert action.max() == task.action_high and action.min() == task.action_low
        assert free(data)["action"].max() > task.action_high
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(actor(data)["action"], policy(data["observation"])[0])
    # It can act in two ways, and both losses and checkpoints find what they look for.
    assert kinds_of(actor) == ("stochastic", "deterministic")
    assert actor.state_dict().keys() == torchrl_actor(policy).state_dict().keys()


def test_the_drawn_action_carries_the_gradient_of_the_distribution() -> None:
    policy = GaussianPolicy(3, 2, (8,), std=0.7)
    data = TensorDict({"observation": torch.randn(5, 3)}, batch_size=[5])
    gradients = []
    for actor in (torchrl_actor(policy), make_actor(policy)):
        torch.manual_seed(1)
        with set_exploration_type(ExplorationType.RANDOM):
            loss = actor(data.clone())["action"].square().sum()
        gradients.append(torch.autograd.grad(loss, list(policy.parameters())))
    for expected, found in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected)


def test_reset_std_touches_nothing_else() -> None:
    policy = GaussianPolicy(3, 2, (8,), std=0.3)
    before = [parameter.clone() for parameter in policy.mean.parameters()]
    policy.reset_std(2.0)
    torch.testing.assert_close(policy.log_std.exp(), torch.full((2,), 2.0))
    for old, new in zip(before, policy.mean.parameters(), strict=True):
        assert torch.equal(old, new)
    with pytest.raises(ValueError, match="positive"):
        policy.reset_std(0.0)


@pytest.mark.parametrize("constant", [None, 1e5])
@pytest.mark.parametrize("hidden", [(), (8,), (16, 8)])
def test_sampler_draws_what_the_policy_does_and_does_not_follow_it(
    hidden: tuple[int, ...], constant: float | None
) -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(4, 2, hidden, std=0.5)
    observation = 3 + 2 * torch.randn(50, 4)
    if constant is not None:  # whose standard deviation is the floor
        observation[:, 1] = constant
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
