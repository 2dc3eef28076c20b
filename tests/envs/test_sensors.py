"""Disturbances of the observation: what is seen, and state through resets."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import (
    BatchedMujocoEnv,
    ObservationNoise,
    RandomSigns,
    SensorBias,
    SensorDelay,
    SensorDropout,
)


class Counter(EnvBase):
    """Its observation counts the steps of each environment from 1, 0 at a reset."""

    def __init__(self, batch: tuple[int, ...] = (3,), entries: int = 2) -> None:
        super().__init__(batch_size=batch)
        self.observation_spec = Composite(
            observation=Unbounded((*batch, entries), dtype=torch.float64), shape=batch
        )
        self.action_spec = Bounded(-1, 1, (*batch, 1))
        self.reward_spec = Unbounded((*batch, 1))
        self.count = torch.zeros(*batch, entries, dtype=torch.float64)

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(self, tensordict: TensorDict | None = None, **kwargs: object) -> TensorDict:
        reset = None if tensordict is None else tensordict.get("_reset", None)
        kept = 0 if reset is None else (~reset).double()
        self.count = self.count * kept
        done = self.full_done_spec.zero()
        return done.set("observation", self.count.clone())

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.count = self.count + 1
        out = self.full_done_spec.zero().set("observation", self.count.clone())
        return out.update(self.full_reward_spec.zero())


def step(env: EnvBase) -> Tensor:
    return env.step(env.full_action_spec.zero())["next", "observation"]


def restart(env: EnvBase, current: Tensor, rows: list[bool]) -> Tensor:
    mask = torch.tensor(rows).unsqueeze(-1)
    state = TensorDict({"_reset": mask, "observation": current}, batch_size=env.batch_size)
    return env.reset(state)["observation"]


def test_bias_is_there_at_resets_too_and_once():
    env = TransformedEnv(Counter(), SensorBias([0.5, -1.0]))
    assert env.reset()["observation"].tolist() == [[0.5, -1.0]] * 3
    seen = step(env)
    assert seen.tolist() == [[1.5, 0.0]] * 3
    after = restart(env, seen, [True, False, False])
    assert after.tolist() == [[0.5, -1.0], [1.5, 0.0], [1.5, 0.0]]
    assert step(env)[:, 0].tolist() == [1.5, 2.5, 2.5]


def test_drawn_bias_changes_only_where_an_episode_starts():
    torch.manual_seed(0)
    env = TransformedEnv(Counter((2,), 30), SensorBias(RandomSigns(0.25)))
    first = env.reset()["observation"]
    assert (first.abs() == 0.25).all()
    seen = step(env)
    torch.testing.assert_close(seen, first + 1)
    after = restart(env, seen, [False, True])
    assert torch.equal(after[0], seen[0]) and not torch.equal(after[1], first[1])
    torch.testing.assert_close(step(env)[1], after[1] + 1)


def test_delay_repeats_the_first_reading_until_there_is_an_older_one():
    env = TransformedEnv(Counter(), SensorDelay(torch.tensor([[0.0], [1.0], [2.0]])))
    env.reset()
    seen = [step(env) for _ in range(4)]
    assert [one[:, 0].tolist() for one in seen] == [[1, 0, 0], [2, 1, 0], [3, 2, 1], [4, 3, 2]]
    after = restart(env, seen[-1], [False, False, True])
    assert after[:, 0].tolist() == [4, 3, 0]
    assert [step(env)[:, 0].tolist() for _ in range(3)] == [[5, 4, 0], [6, 5, 0], [7, 6, 1]]


@pytest.mark.parametrize("whole", [False, True])
def test_dropout_holds_what_was_read_last(whole):
    torch.manual_seed(0)
    env = TransformedEnv(Counter((2000,), 2), SensorDropout(0.3, whole=whole))
    last = env.reset()["observation"]
    for count in range(1, 5):
        seen = step(env)
        lost = seen != count
        assert torch.equal(seen, torch.where(lost, last, torch.full_like(seen, count)))
        assert lost.double().mean().item() == pytest.approx(0.3, abs=0.04)
        assert torch.equal(lost[:, 0], lost[:, 1]) == whole
        last = seen
    after = restart(env, last, [True] + [False] * 1999)
    assert (after[0] == 0).all() and torch.equal(after[1:], last[1:])
    seen = step(env)
    assert set(seen[0].tolist()) <= {0.0, 1.0}


def test_sure_loss_shows_the_reset_for_ever():
    env = TransformedEnv(Counter(), SensorDropout(1.0))
    rollout = env.rollout(5)
    assert (rollout["next", "observation"] == 0).all()


@pytest.mark.parametrize("transform", [SensorBias(0.1), SensorDelay(2), SensorDropout(0.5)])
def test_on_gymnasium_batched_and_not(transform):
    assert not transform.matched
    single = TransformedEnv(GymEnv("InvertedPendulum-v5"), copy.deepcopy(transform))
    check_env_specs(single)
    assert single.rollout(20, break_when_any_done=False).shape == (20,)
    vectorized = GymEnv("InvertedPendulum-v5", num_envs=2)
    many = TransformedEnv(vectorized, copy.deepcopy(transform), auto_unwrap=True)
    rollout = many.rollout(40, break_when_any_done=False)
    assert rollout["next", "done"].any()
    inner = ~rollout["next", "done"][:, :-1].squeeze(-1)
    carried, seen = rollout["observation"][:, 1:], rollout["next", "observation"][:, :-1]
    assert torch.equal(carried[inner], seen[inner])
    many.close()


def test_refusals():
    with pytest.raises(ValueError, match="between 0 and 1"):
        SensorDropout(1.5)
    with pytest.raises(ValueError, match="whole"):
        SensorDelay(-1)
    with pytest.raises(ValueError, match="3 values, but the observation 'observation' has 2"):
        TransformedEnv(Counter(), SensorBias([1.0, 2.0, 3.0])).reset()
    with pytest.raises(RuntimeError, match="belongs to an environment"):
        SensorBias(0.1)(TensorDict({"observation": torch.zeros(2, 2)}, batch_size=[2]))


class SelfResetting(Counter):
    """Begins an episode within the step that ends one, as simulators on a GPU do."""

    def __init__(self) -> None:
        super().__init__()
        self._torchrl_native_autoreset = True

    def _step(self, tensordict: TensorDict) -> TensorDict:
        out = super()._step(tensordict)
        over = (self.count >= torch.tensor([[2.0], [3.0], [9.0]])).any(-1, keepdim=True)
        self.count = torch.where(over, 0.0, self.count)
        out["done"], out["terminated"] = over, over.clone()
        return out.set("observation", self.count.clone())


@pytest.mark.parametrize(
    ("chain", "expected"),
    [
        ([SensorBias(0.5)], [[0.5, 1.5, 0.5, 1.5, 0.5], [0.5, 1.5, 2.5, 0.5, 1.5]]),
        ([SensorDelay(1)], [[0, 0, 0, 0, 0], [0, 0, 1, 0, 0]]),
        ([SensorDropout(1.0)], [[0, 0, 0, 0, 0], [0, 0, 0, 0, 0]]),
        (
            [SensorDelay(1), SensorBias(0.5)],
            [[0.5, 0.5, 0.5, 0.5, 0.5], [0.5, 0.5, 1.5, 0.5, 0.5]],
        ),
        (
            [SensorBias(0.5), SensorDelay(1)],
            [[0.5, 0.5, 0.5, 0.5, 0.5], [0.5, 0.5, 1.5, 0.5, 0.5]],
        ),
    ],
    ids=["bias", "delay", "dropout", "delay and bias", "bias and delay"],
)
def test_environments_that_reset_themselves_are_disturbed_once(chain, expected):
    env = TransformedEnv(SelfResetting(), Compose(*chain))
    seen = env.rollout(5, break_when_any_done=False)["observation"]
    assert seen[:2, :, 0].tolist() == expected


def test_first_observations_of_environments_that_reset_themselves_are_free_of_noise():
    torch.manual_seed(0)
    env = TransformedEnv(
        SelfResetting(), Compose(ObservationNoise(0.1), SensorBias(RandomSigns(1.0)))
    )
    seen = env.rollout(6, break_when_any_done=False)["observation"][0]
    first = seen[::2]
    assert torch.equal(first.abs(), torch.ones(3, 2, dtype=torch.float64))
    assert (first != first[0]).any()  # drawn anew
    assert (seen[1::2] != first + 1).all() and (seen[1::2] - first - 1).abs().max() < 0.1


@pytest.mark.parametrize(
    "make", [lambda: SensorBias(0.5), lambda: SensorDelay(2), lambda: ObservationNoise(0.1)]
)
def test_environments_that_a_mask_leaves_out_see_what_they_saw(make):
    base = BatchedMujocoEnv("hopper", 3, seed=0)
    env = TransformedEnv(base, Compose(make(), SensorDropout(0.5)))
    torch.manual_seed(0)
    state = env.rand_step(env.reset())
    state = env.rand_step(env.step_mdp(state))
    masked = env.step_mdp(state).set("_step", torch.tensor([[True], [False], [True]]))
    seen = env.step(masked.set("action", env.action_spec.zero()))["next", "observation"]
    same = (seen == state["next", "observation"]).all(-1)
    assert same.tolist() == [False, True, False]
