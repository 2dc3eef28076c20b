from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.wrappers import TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import (
    Compose,
    FrameSkipTransform,
    GymEnv,
    GymWrapper,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from torchrl_l1.control import time_step
from torchrl_l1.envs import (
    BatchedMujocoEnv,
    ExternalTask,
    Task,
    Uniform,
    disturbed_model,
    environment_source,
    get_task,
    make_env,
)

FORWARD = Box(-1.0, 1.0, (1,), np.float32)
ANY = Box(-np.inf, np.inf, (2,), np.float64)


class Cart(gymnasium.Env):
    """A cart on a line, and whatever a test wants it to be."""

    dt = 0.1

    def __init__(self, action_space=FORWARD, observation_space=ANY, bad_after=None, ends=None):
        self.action_space, self.observation_space = action_space, observation_space
        self.bad_after, self.ends = bad_after, ends

    def observe(self):
        return self.state.copy()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.np_random.uniform(-0.1, 0.1, 2), 0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        self.state = self.state + self.dt * np.array([self.state[1], action.sum()])
        observation = self.observe()
        if self.steps == self.bad_after:
            observation = observation * np.nan
        over = self.steps == self.ends
        return observation, float(-np.square(self.state).sum()), over, False, {}


class InParts(Cart):
    """With a goal beside the observation."""

    def __init__(self):
        space = Dict(observation=ANY, goal=Box(-1, 1, (1,)), height=Box(-1, 1, ()))
        super().__init__(observation_space=space)

    def observe(self):
        return {"observation": self.state, "goal": np.zeros(1), "height": np.array(0.5)}


def task_of(make, **settings) -> ExternalTask:
    return ExternalTask(environment_source(make), **{"horizon": 20, **settings})


def test_facts_are_those_of_the_environment():
    task = get_task("gymnasium/Reacher-v5")
    assert isinstance(task, ExternalTask)
    made = gymnasium.make("Reacher-v5")
    assert (task.observation_dim, task.action_dim) == (10, 2)
    assert (task.action_low, task.action_high) == (-1.0, 1.0)
    assert task.dt == made.unwrapped.dt
    assert task.horizon == made.spec.max_episode_steps


def test_bounds_may_differ_from_entry_to_entry():
    space = Box(np.array([-1, 0], np.float32), np.array([1, 5], np.float32))
    task = task_of(lambda: Cart(space))
    assert task.action_low == (-1.0, 0.0) and task.action_high == (1.0, 5.0)
    env = task.environment(3, seed=0)
    actions = env.rand_action()["action"]
    assert actions.shape == (3, 2)
    assert bool((actions[:, 1] >= 0).all())


@pytest.mark.parametrize("name", ["Pendulum-v1", "Reacher-v5", "HalfCheetah-v5"])
def test_steps_are_those_of_gymnasium(name):
    env = get_task(f"gymnasium/{name}").environment(2, seed=3)
    state = env.reset()
    rng = np.random.default_rng(3)
    peers = [gymnasium.make(name) for _ in range(2)]
    starts = [peer.reset(seed=int(rng.integers(2**31)))[0] for peer in peers]
    np.testing.assert_array_equal(state["observation"], np.float32(starts))
    for _ in range(20):
        data = env.rand_step(state)
        for index, peer in enumerate(peers):
            observation, reward, *_ = peer.step(data["action"][index].numpy())
            np.testing.assert_array_equal(
                data["next", "observation"][index], np.float32(observation)
            )
            assert data["next", "reward"][index].item() == np.float32(reward)
        state = data["next"].select("observation")


@settings(max_examples=20, deadline=None)
@given(
    ends=st.integers(1, 12),
    horizon=st.integers(1, 12),
    count=st.integers(1, 4),
    seed=st.integers(0, 2**31 - 1),
)
def test_episodes_end_where_they_should(ends, horizon, count, seed):
    env = make_env(task_of(lambda: Cart(ends=ends), horizon=horizon), count, seed=seed)
    data = env.rollout(24, break_when_any_done=False)
    length = min(ends, horizon)
    done = torch.arange(1, 25) % length == 0
    assert torch.equal(data["next", "done"][..., 0], done.expand(count, 24))
    assert bool(data["next", "terminated"].any()) == (ends <= horizon)
    again = make_env(task_of(lambda: Cart(ends=ends), horizon=horizon), count, seed=seed)
    torch.manual_seed(0)
    first = again.rollout(5, break_when_any_done=False)["observation"]
    again.set_seed(seed)
    torch.manual_seed(0)
    assert torch.equal(again.rollout(5, break_when_any_done=False)["observation"], first)


def test_what_follows_a_seed_does_not_depend_on_what_was_before():
    env = task_of(Cart).environment(2, seed=0)
    fresh = env.reset()["observation"]
    env.rollout(30, break_when_any_done=False)
    env.set_seed(0)
    assert torch.equal(env.reset()["observation"], fresh)


def test_others_go_on_when_one_is_reset():
    env = task_of(Cart).environment(3, seed=0)
    data = env.rand_step(env.reset())
    mask = torch.tensor([[False], [True], [False]])
    state = data["next"].select("observation", "done", "terminated", "truncated")
    after = env.reset(state.set("_reset", mask))["observation"]
    same = (after == data["next", "observation"]).all(-1)
    assert same.tolist() == [True, False, True]


def test_environments_that_a_mask_leaves_out_stay_as_they_are():
    env = task_of(Cart).environment(2, seed=0)
    data = env.rand_step(env.reset())
    masked = env.step_mdp(data).set("_step", torch.tensor([[True], [False]]))
    stayed = env.step(masked.set("action", torch.tensor([[0.5], [torch.nan]])))["next"]
    assert [member.env.unwrapped.steps for member in env.members] == [2, 1]
    assert torch.equal(stayed["observation"][1], data["next", "observation"][1])
    assert stayed["reward"][1] == 0 and stayed["reward"][0] != 0
    assert env._steps.tolist() == [2, 1]


def test_steps_that_are_not_finite_end_the_episode_and_are_told():
    env = task_of(lambda: Cart(bad_after=3)).environment(2, seed=0)
    data = env.rollout(10)
    assert data.shape[1] == 3
    assert data["next", "non_finite"][:, -1].all() and data["next", "terminated"][:, -1].all()
    assert torch.equal(data["next", "observation"][:, -1], data["observation"][:, -1])
    assert data["next", "reward"][:, -1].eq(0).all()


def test_a_reward_that_single_precision_cannot_hold_is_not_finite():
    class Rich(Cart):
        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, 1e39 if self.steps == 2 else 1.0, *rest

    data = task_of(Rich).environment(2, seed=0).rollout(10)
    assert data["next", "non_finite"][..., 0].tolist() == [[False, True]] * 2
    assert data["next", "reward"][..., 0].tolist() == [[1.0, 0.0]] * 2


def test_actions_beyond_the_bounds_are_clipped():
    env = task_of(Cart).environment(1, seed=0)  # the cart itself takes no others
    state = env.reset()
    beyond = env.step(state.clone().set("action", torch.full((1, 1), 7.0)))
    env.set_seed(0)
    at = env.step(env.reset().set("action", torch.ones(1, 1)))
    assert torch.equal(beyond["next", "observation"], at["next", "observation"])


def test_observations_in_parts_are_chosen_by_name():
    with pytest.raises(ValueError, match=r"observation_keys=\["):
        task_of(InParts)
    task = task_of(InParts, observation_keys=["goal", "observation", "height"])
    assert task.observation_dim == 4
    data = task.environment(2, seed=0).rollout(3)
    assert data["observation"].dtype == torch.float32
    assert data["observation"][..., 0].eq(0).all() and data["observation"][..., 3].eq(0.5).all()
    with pytest.raises(ValueError, match="no vector 'nothing'"):
        task_of(InParts, observation_keys=["nothing"])
    with pytest.raises(ValueError, match="twice"):
        task_of(InParts, observation_keys=["goal", "goal"])


@pytest.mark.parametrize(
    ("action", "observation", "words"),
    [
        (Discrete(3), ANY, "Discrete.* as actions"),
        (Box(-1, 1, (2, 2)), ANY, "shape .2, 2. as actions"),
        (Box(0, 9, (1,), np.int64), ANY, "as actions"),
        (Box(-np.inf, np.inf, (1,), np.float32), ANY, "unbounded actions"),
        (Box(-3e38, 3e38, (1,), np.float32), ANY, "unbounded actions"),
        (FORWARD, Box(0, 255, (8, 8, 3), np.uint8), "images.*FlattenObservation makes from tables"),
        (FORWARD, Discrete(4), "as observations"),
        (FORWARD, Dict(camera=Box(0, 255, (8, 8, 3), np.uint8)), "no vectors"),
    ],
)
def test_environments_that_will_not_do_are_refused(action, observation, words):
    with pytest.raises(ValueError, match=words) as caught:
        task_of(lambda: Cart(action, observation))
    assert "\n" not in str(caught.value)


def test_what_an_environment_does_not_tell_is_asked_for():
    with pytest.raises(ValueError, match=r"give dt=SECONDS"):
        get_task("gymnasium/MountainCarContinuous-v0")
    assert get_task("gymnasium/MountainCarContinuous-v0", dt=1.0).dt == 1.0
    with pytest.raises(ValueError, match=r"give horizon=STEPS"):
        ExternalTask(environment_source(Cart))
    with pytest.raises(ValueError, match=r"takes 0.05 s, not 0.1: leave dt out, or correct"):
        get_task("gymnasium/Pendulum-v1", dt=0.1)
    with pytest.raises(ValueError, match="leave dt out"):
        get_task("half_cheetah", dt=1.0)


def test_of_several_time_limits_the_shortest_counts():
    for limits in ((200, 300), (300, 200)):

        def make(limits=limits):
            return TimeLimit(TimeLimit(Cart(), limits[0]), limits[1])

        assert ExternalTask(environment_source(make)).horizon == 200
        assert task_of(make, horizon=100).horizon == 100
        with pytest.raises(ValueError, match="ends after 200 steps, not 250: leave horizon out"):
            task_of(make, horizon=250)


def test_own_tasks_stay_what_they_are():
    assert isinstance(get_task("half_cheetah"), Task)
    with pytest.raises(KeyError, match="Unknown task 'half_cheeta'"):
        get_task("half_cheeta")


def test_the_packages_own_ids_have_their_rewards():
    task = get_task("gymnasium/torchrl_l1/Cartpole-v0")
    own = get_task("cartpole")
    assert (task.dt, task.horizon) == (own.dt, own.horizon)
    x, u = torch.randn(5, 4), torch.randn(5, 1)
    assert torch.equal(task.imagined_reward(x, u, x), own.imagined_reward(x, u, x))


def test_environments_of_torchrl():
    task = task_of(lambda: TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(7)), horizon=None)
    assert (task.horizon, task.dt) == (7, 0.05)
    env = task.environment(2, seed=1)
    assert time_step(env) == 0.05
    torch.manual_seed(0)
    data = env.rollout(20, break_when_any_done=False)
    assert data["next", "truncated"][:, 6::7].all()
    generator = torch.random.get_rng_state()
    env.set_seed(1)
    env.reset()
    assert torch.equal(torch.random.get_rng_state(), generator)
    torch.manual_seed(0)
    env.set_seed(1)
    assert torch.equal(
        env.rollout(20, break_when_any_done=False)["observation"], data["observation"]
    )


@pytest.mark.parametrize(("ends", "late"), [(3, False), (9, True)])
def test_episodes_of_torchrl_end_as_they_say(ends, late):
    # With a step counter it is TorchRL that steps it.
    limited = lambda: TransformedEnv(GymWrapper(Cart(ends=ends)), StepCounter(5))  # noqa: E731
    env = task_of(limited, horizon=None).environment(1, seed=0, max_steps=8)
    last = env.rollout(20)["next"][0, -1]
    assert (bool(last["terminated"]), bool(last["truncated"])) == (not late, late)


def test_batches_and_missing_vectors_of_torchrl_are_refused():
    with pytest.raises(ValueError, match="is a batch"):
        task_of(lambda: GymEnv("Pendulum-v1", num_envs=2))
    with pytest.raises(ValueError, match=r"as actions|continuous"):
        task_of(lambda: TransformedEnv(GymEnv("CartPole-v1"), StepCounter()))


def test_plants_of_gymnasiums_mujoco_can_be_changed():
    task = get_task("gymnasium/InvertedPendulum-v5")
    plain, heavy = (make_env(task, 2, seed=0, **more) for more in ({}, {"mass": 2.0}))
    members = [env.base_env.members[0] for env in (plain, heavy)]
    before, after = (member.simulation().model.body_mass for member in members)
    np.testing.assert_allclose(after, 2 * before)
    with pytest.raises(ValueError, match="wind"):
        make_env(task, 2, wind=0.5)
    with pytest.raises(ValueError, match="mass changes the plant"):
        make_env("gymnasium/Pendulum-v1", 2, mass=2.0)


def test_plants_of_gymnasiums_mujoco_have_values_of_their_own():
    task = get_task("gymnasium/InvertedPendulum-v5")
    actions = torch.linspace(-1, 1, 6).reshape(6, 1)

    def masses(env):
        models = [member.simulation().model for member in env.base_env.members]
        return [model.body_mass.sum() for model in models]

    (plain,) = masses(make_env(task, 1, seed=0))
    env = make_env(task, 2, seed=0, mass=[1.5, 3.0])
    np.testing.assert_allclose(masses(env), [1.5 * plain, 3.0 * plain])
    data = env.reset()
    made = gymnasium.make("InvertedPendulum-v5").unwrapped
    made.model = disturbed_model(made.model, {"mass": 3.0})
    made.reset(seed=0)
    state = data["observation"][1].double().numpy()
    made.set_state(state[:2], state[2:])
    env.base_env.members[1].simulation().set_state(state[:2], state[2:])
    for action in actions:
        data = env.step_mdp(env.step(data.set("action", action.expand(2, 1))))
        expected = made.step(action.numpy())[0]
        np.testing.assert_allclose(data["observation"][1], expected, rtol=1e-5, atol=1e-7)
    torch.manual_seed(0)
    env = make_env(task, 2, seed=0, mass=Uniform(1.5, 3.0))
    env.reset()
    first = masses(env)
    assert all(1.5 * plain < mass < 3.0 * plain for mass in first) and first[0] != first[1]
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    second = masses(env)
    assert second[0] != first[0] and second[1] == first[1]
    with pytest.raises(ValueError, match="expected one number, or one for"):
        make_env(task, 2, mass=[1.0, 2.0, 3.0])


class Thrice(gymnasium.Wrapper):
    """Takes each action three times, as some packages write it."""

    def __init__(self, env):
        super().__init__(env)
        self._skip = 3

    def step(self, action):
        for _ in range(self._skip):
            observation, reward, terminated, truncated, info = self.env.step(action)
            if terminated or truncated:
                break
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize(
    "make",
    [
        lambda: GymEnv("Pendulum-v1", frame_skip=3),
        lambda: TransformedEnv(GymEnv("Pendulum-v1"), FrameSkipTransform(3)),
        lambda: GymWrapper(TimeLimit(Cart(), 200), frame_skip=3),
        lambda: Thrice(TimeLimit(Cart(), 200)),
        lambda: TimeLimit(Thrice(TimeLimit(Cart(), 500)), 67),
        lambda: TransformedEnv(GymWrapper(Cart()), Compose(StepCounter(67), FrameSkipTransform(3))),
    ],
    ids=["wrapper", "transform", "own limit", "gymnasium", "limit around", "counter of steps"],
)
def test_horizons_count_steps_and_not_the_frames_that_they_skip(make):
    task = task_of(make, horizon=None)
    assert task.horizon == 67
    # The environment itself ends there: given more, an episode is no longer.
    data = task.environment(1, seed=0, max_steps=100).rollout(100)
    assert data.shape == (1, 67) and data["next", "truncated"][0, -1]


def test_a_reward_that_is_not_known_is_said():
    task = task_of(Cart)
    with pytest.raises(ValueError, match=r"reward=learned or reward=MODULE:FUNCTION"):
        task.imagined_reward
    with pytest.raises(ValueError, match=r"termination=learned, none or"):
        task.terminates


def test_a_package_that_gymnasium_lacks_is_named(monkeypatch):
    def lacking(*_, **__):
        raise gymnasium.error.DependencyNotInstalled("Box2D is not installed")

    monkeypatch.setattr(gymnasium, "make", lacking)
    with pytest.raises(ValueError, match="gymnasium/Pendulum-v1: Box2D is not installed"):
        ExternalTask(environment_source("gymnasium/Pendulum-v1"))


class OfGym(Cart):
    """What Gym's environments returned before Gymnasium."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0]


class OfGymAtSteps(Cart):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated or truncated, info


class Scalar(Cart):
    """An observation that NumPy would spread over all entries."""

    def step(self, action):
        return np.float32(0.5), *super().step(action)[1:]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (OfGym, r"reset does not return \(observation, info\)"),
        (
            OfGymAtSteps,
            r"step does not return \(observation, reward, terminated, ",
        ),
        (Scalar, r"an observation of shape \(\), and its observation space has 2 entries"),
    ],
)
def test_what_an_environment_returns_must_be_what_it_says(make, words):
    with pytest.raises(ValueError, match=words):
        task_of(make, horizon=5).environment(2, seed=0).rollout(2)


def test_horizons_that_are_none():
    for horizon in (0, 2.5):
        with pytest.raises(ValueError, match=r"horizon must be .*, got (0|2.5)"):
            task_of(Cart, horizon=horizon)


def test_a_batch_of_one_is_not_asked_for_its_members():
    task = task_of(lambda: SerialEnv(1, lambda: GymWrapper(Cart())), horizon=5, dt=0.1)
    assert not task.has_plant and task.environment(2, seed=0).rollout(3).shape == (2, 3)
    with pytest.raises(ValueError, match="does not declare how long an episode is"):
        task_of(lambda: SerialEnv(1, lambda: GymWrapper(Cart())), horizon=None, dt=0.1)


@pytest.mark.parametrize("wrap", [lambda env: env, GymWrapper])
def test_a_function_that_keeps_its_environment_is_refused(wrap):
    kept = wrap(Cart())
    make_two = [task_of(lambda: kept).environment, environment_source(lambda: kept).several]
    for make in make_two:
        with pytest.raises(ValueError, match="returns the same environment twice"):
            make(2)


def test_names_of_files_are_those_of_the_folder_and_of_their_text(tmp_path, monkeypatch):
    text = (
        Path(__file__)
        .read_text()
        .replace("ANY = Box(-np.inf, np.inf, (2,)", "ANY = Box(-9, 9, ({},)")
    )
    for folder, width in (("one", 3), ("other", 4)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "cart_of_a_test.py").write_text(text.replace("{}", str(width)))
    found = []
    for folder in ("one", "other", "one"):
        monkeypatch.chdir(tmp_path / folder)
        found.append(get_task("cart_of_a_test.py:Cart", horizon=5))
    assert [task.observation_dim for task in found] == [3, 4, 3] and found[0] is found[2]
    Path("cart_of_a_test.py").write_text(text.replace("{}", "5"))
    assert get_task("cart_of_a_test.py:Cart", horizon=5).observation_dim == 5


def own_tasks() -> BatchedMujocoEnv:
    return BatchedMujocoEnv("hopper", max_steps=200)


def heavy() -> BatchedMujocoEnv:
    return BatchedMujocoEnv("hopper", plant={"mass": 1.5})


def test_what_differs_from_a_task_of_ours_is_kept_or_refused():
    assert get_task(f"{__file__}:own_tasks").horizon == 200
    assert get_task(f"{__file__}:own_tasks", horizon=33).horizon == 33
    with pytest.raises(ValueError, match="another plant"):
        get_task(f"{__file__}:heavy")
    with pytest.raises(ValueError, match="dt: a step of hopper"):
        get_task(f"{__file__}:own_tasks", dt=0.02)
