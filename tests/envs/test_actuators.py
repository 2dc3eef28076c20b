"""Disturbances of the action: what is executed, its inverse, and state through resets."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import (
    Compose,
    ConditionalSkip,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    MultiAction,
    NoopResetEnv,
    PendulumEnv,
    RenameTransform,
    SerialEnv,
    Transform,
    TransformedEnv,
    UnsqueezeTransform,
)
from torchrl.envs.utils import check_env_specs

from torchrl_l1.control import ActionJacobian, L1Transform, OracleTransform
from torchrl_l1.envs import (
    ActionNoise,
    ActuatorBias,
    ActuatorDelay,
    ActuatorGain,
    BatchedMujocoEnv,
    DeadZone,
    FailingMotor,
    ObservationNoise,
    RandomSigns,
    SensorBias,
    SensorDelay,
    SensorDropout,
    SineBias,
    StepBias,
    Stiction,
    Uniform,
    WalkBias,
    disturbance_transforms,
)


class Echo(EnvBase):
    """Its observation is the action that it received; rows end when they are told to."""

    def __init__(self, batch: tuple[int, ...] = (3,), entries: int = 2) -> None:
        super().__init__(batch_size=batch)
        self.observation_spec = Composite(
            observation=Unbounded((*batch, entries), dtype=torch.float64), shape=batch
        )
        self.action_spec = Bounded(-1, 1, (*batch, entries), dtype=torch.float64)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float64)

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(self, tensordict: TensorDict | None = None, **kwargs: object) -> TensorDict:
        return self.full_observation_spec.zero().update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDict) -> TensorDict:
        out = self.full_done_spec.zero().set("observation", tensordict["action"].clone())
        return out.update(self.full_reward_spec.zero())


def send(env: EnvBase, action: Tensor) -> Tensor:
    """What the environment received."""
    state = TensorDict({"action": action}, batch_size=env.batch_size)
    return env.step(state)["next", "observation"]


def restart(env: EnvBase, rows: list[bool]) -> None:
    mask = torch.tensor(rows).unsqueeze(-1)
    env.reset(TensorDict({"_reset": mask}, batch_size=env.batch_size))


class EchoOfAgents(Echo):
    """Its only ``done`` is that of two agents."""

    def __init__(self) -> None:
        super().__init__()
        done = Binary(shape=(3, 2, 1), dtype=torch.bool)
        agent = Composite(done=done, terminated=done.clone(), shape=[3])
        self.full_done_spec = Composite(agent=agent, shape=[3])


MATCHED = [
    lambda v: ActuatorBias(v),
    lambda v: ActuatorBias([v, -v]),
    lambda v: ActuatorBias(torch.full((3, 1), v)),
    lambda v: ActuatorBias(RandomSigns(v)),
    lambda v: SineBias(v, period=7),
    lambda v: StepBias(v, at=2),
    lambda v: WalkBias(v),
    lambda v: ActuatorGain(1 + v),
    lambda v: ActuatorGain(Uniform(0.5, 0.5 + v)),
    lambda v: DeadZone(v),
]


@pytest.mark.parametrize("make", MATCHED)
@given(value=st.floats(0, 3), seed=st.integers(0, 100))
@settings(max_examples=8, deadline=None)
def test_compensation_is_the_inverse_and_changes_nothing(make, value, seed):
    torch.manual_seed(seed)
    env = TransformedEnv(Echo(), transform := make(value))
    assert transform.matched
    env.reset()
    for step in range(6):
        wanted = 2 * torch.rand(3, 2, dtype=torch.float64) - 1
        generator = torch.get_rng_state()
        sent = transform.compensate(wanted)
        assert torch.equal(sent, transform.compensate(wanted))
        assert torch.equal(torch.get_rng_state(), generator)
        torch.testing.assert_close(send(env, sent), wanted)
        if step == 3:
            restart(env, [True, False, True])


def test_what_does_not_reach_a_dead_motor_is_left_as_it_is():
    wanted = torch.tensor([[0.5, 0.25], [0.0, 0.0]], dtype=torch.float64)
    for transform, sent in [(ActuatorGain([0.5, 0]), [1, 0.25]), (FailingMotor(0), [0.5, 0.25])]:
        env = TransformedEnv(Echo((2,)), transform)
        env.reset()
        assert transform.compensate(wanted).tolist() == [sent, [0, 0]]


def test_bias_of_random_signs_is_drawn_anew_where_an_episode_starts():
    torch.manual_seed(0)
    env = TransformedEnv(Echo((3,), 20), ActuatorBias(RandomSigns(0.3)))
    env.reset()
    zero = torch.zeros(3, 20, dtype=torch.float64)
    first = send(env, zero)
    torch.testing.assert_close(first.abs(), torch.full_like(first, 0.3), rtol=1e-6, atol=0)
    assert 10 < (first > 0).sum() < 50
    assert torch.equal(send(env, zero), first)
    restart(env, [False, True, False])
    second = send(env, zero)
    assert torch.equal(second[[0, 2]], first[[0, 2]])
    assert not torch.equal(second[1], first[1])


@pytest.mark.parametrize(
    "magnitude",
    [
        [0.1, 0.2],
        torch.tensor([0.1, 0.2]),
        torch.tensor([[0.1], [0.2], [0.3]]),
        Uniform(0.1, 0.3),
        Uniform(0.1, 0.3, shared=True),
    ],
    ids=["entries", "tensor", "rows", "drawn", "drawn for each environment"],
)
def test_magnitudes_of_random_signs_are_values_like_any_other(magnitude):
    torch.manual_seed(0)
    (transform,) = disturbance_transforms(signs=magnitude)
    env = TransformedEnv(Echo((3,), 2), transform)
    env.reset()
    received = send(env, torch.zeros(3, 2, dtype=torch.float64))
    assert (received > 0).any() and (received < 0).any()
    if isinstance(magnitude, Uniform):
        assert (received.abs() >= 0.1).all() and (received.abs() < 0.3).all()
        assert bool((received[:, 0].abs() == received[:, 1].abs()).all()) == magnitude.shared
    else:
        expected = torch.as_tensor(magnitude).double().expand(3, 2)
        torch.testing.assert_close(received.abs(), expected)


def test_magnitudes_that_do_not_fit_are_refused():
    env = TransformedEnv(Echo((3,), 2), ActuatorBias(RandomSigns([0.1, 0.2, 0.3])))
    with pytest.raises(ValueError, match=r"RandomSigns has magnitudes of shape \(3,\)"):
        env.reset()


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        (SineBias(0.5, period=8), lambda t: 0.5 * math.sin(2 * math.pi * t / 8)),
        (StepBias(0.5, at=3), lambda t: 0.5 if t >= 3 else 0.0),
    ],
)
def test_biases_in_time_count_from_each_reset(transform, expected):
    env = TransformedEnv(Echo(), transform)
    env.reset()
    zero = torch.zeros(3, 2, dtype=torch.float64)
    since = [0, 0, 0]
    for step in range(12):
        received = send(env, zero)
        torch.testing.assert_close(
            received[:, 0], torch.tensor([expected(t) for t in since]).double()
        )
        since = [t + 1 for t in since]
        if step == 4:
            restart(env, [True, False, False])
            since[0] = 0


def test_walk_spreads_with_the_square_root_of_time_and_starts_at_zero():
    torch.manual_seed(0)
    env = TransformedEnv(Echo((2000,), 2), WalkBias(0.1))
    env.reset()
    zero = torch.zeros(2000, 2, dtype=torch.float64)
    assert (send(env, zero) == 0).all()
    for _ in range(8):
        send(env, zero)
    assert send(env, zero).std().item() == pytest.approx(0.3, rel=0.05)
    restart(env, [True] + [False] * 1999)
    after = send(env, zero)
    assert (after[0] == 0).all() and (after[1:] != 0).all()


def test_only_one_motor_fails():
    action = torch.ones(3, 4, dtype=torch.float64)
    env = TransformedEnv(Echo((3,), 4), FailingMotor(0.25, motor=2))
    env.reset()
    assert send(env, action).tolist() == [[1, 1, 0.25, 1]] * 3
    torch.manual_seed(0)
    env = TransformedEnv(Echo((50,), 4), FailingMotor(0.0, motor=None))
    env.reset()
    received = send(env, torch.ones(50, 4, dtype=torch.float64))
    assert (received.sum(-1) == 3).all() and (received == 0).any(0).all()
    with pytest.raises(ValueError, match="no motor 4 among 4"):
        TransformedEnv(Echo((3,), 4), FailingMotor(0.0, motor=4)).reset()


def test_dead_zone_and_stiction_by_hand():
    env = TransformedEnv(Echo((1,), 4), DeadZone(0.25))
    env.reset()
    received = send(env, torch.tensor([[0.25, -0.2, 0.75, -1.0]]).double())
    assert received.tolist() == [[0, 0, 0.5, -0.75]]
    env = TransformedEnv(Echo((2,), 1), Stiction(0.25))
    env.reset()
    sent = [0.125, 0.5, 0.375, 0.75, 0.8125, 0.375]
    outputs = [send(env, torch.full((2, 1), one).double()) for one in sent]
    assert [one[0].item() for one in outputs] == [0, 0.5, 0.5, 0.5, 0.8125, 0.375]
    restart(env, [True, False])
    assert send(env, torch.full((2, 1), 0.25).double()).tolist() == [[0.0], [0.375]]


def test_delay_of_each_environment_restarts_with_it():
    env = TransformedEnv(Echo((3,), 1), ActuatorDelay(torch.tensor([[0.0], [1.0], [2.0]])))
    env.reset()
    received = [send(env, torch.full((3, 1), float(k)).double())[:, 0].tolist() for k in (1, 2, 3)]
    assert received == [[1, 0, 0], [2, 1, 0], [3, 2, 1]]
    restart(env, [False, False, True])
    received = [send(env, torch.full((3, 1), float(k)).double())[:, 0].tolist() for k in (4, 5, 6)]
    assert received == [[4, 3, 0], [5, 4, 0], [6, 5, 4]]


def test_drawn_delays_keep_the_memory_of_the_others():
    delays = iter([torch.tensor([[1.0], [3.0]]), torch.tensor([[4.0], [0.0]])])
    env = TransformedEnv(Echo((2,), 1), ActuatorDelay(lambda shape: next(delays)))
    env.reset()
    for k in (1, 2, 3):
        send(env, torch.full((2, 1), float(k)).double())
    restart(env, [True, False])
    received = [
        send(env, torch.full((2, 1), float(k)).double())[:, 0].tolist() for k in range(4, 9)
    ]
    assert received == [[0, 1], [0, 2], [0, 3], [0, 4], [4, 5]]


@pytest.mark.parametrize(
    "transform",
    [
        ActuatorBias(RandomSigns(0.3)),
        SineBias(0.1),
        StepBias(0.1, at=1),
        WalkBias(0.1),
        ActuatorGain(0.5),
        FailingMotor(0.5, motor=None),
        DeadZone(0.1),
        Stiction(0.1),
        ActuatorDelay(2),
    ],
)
def test_on_gymnasium_batched_and_not(transform: Transform):
    single = TransformedEnv(GymEnv("InvertedPendulum-v5"), copy.deepcopy(transform))
    check_env_specs(single)
    assert single.rollout(20, break_when_any_done=False).shape == (20,)
    vectorized = GymEnv("InvertedPendulum-v5", num_envs=2)
    many = TransformedEnv(vectorized, copy.deepcopy(transform), auto_unwrap=True)
    rollout = many.rollout(40, break_when_any_done=False)
    assert rollout.shape == (2, 40) and rollout["next", "done"].any()
    many.close()
    again = pickle.loads(pickle.dumps(transform))
    assert repr(again) == repr(transform)


def test_environments_of_any_batch_have_values_of_their_own():
    params = PendulumEnv.gen_params(batch_size=[64])
    env = TransformedEnv(PendulumEnv(), ActuatorBias(RandomSigns(0.3)))
    zero = env.reset(params, set_state=True).set("action", torch.zeros(64, 1))
    speeds = env.step(zero)["next", "thdot"] - PendulumEnv().step(zero)["next", "thdot"]
    assert (speeds > 0).any() and (speeds < 0).any()
    rows = torch.linspace(-1, 1, 64).unsqueeze(-1)
    env = TransformedEnv(PendulumEnv(), ActuatorBias(rows))
    zero = env.reset(params, set_state=True).set("action", torch.zeros(64, 1))
    speeds = env.step(zero)["next", "thdot"]
    same = PendulumEnv().step(zero.set("action", rows))["next", "thdot"]
    torch.testing.assert_close(speeds, same)


STEPPING = {
    "frames": lambda: FrameSkipTransform(3),
    "chunks": MultiAction,
    "noops": lambda: NoopResetEnv(2),
}
ALWAYS, IN_FRAMES, NEVER = {"frames", "chunks", "noops"}, {"frames"}, set()


@pytest.mark.parametrize(
    ("make", "refused"),
    [
        (lambda: ActuatorBias(0.1), IN_FRAMES),
        (lambda: ActuatorBias(RandomSigns(0.1)), ALWAYS),
        (lambda: ActuatorDelay(1), ALWAYS),
        (lambda: ActionNoise(0.1), IN_FRAMES),
        (lambda: SensorDelay(1), ALWAYS),
        (lambda: SensorBias(0.1), NEVER),
        (lambda: ObservationNoise(0.1), NEVER),
    ],
)
@pytest.mark.parametrize("kind", STEPPING)
def test_what_steps_the_environment_itself_comes_before_or_around(make, refused, kind):
    def chain(*transforms):
        return TransformedEnv(Echo((1,)), Compose(*transforms))

    later = STEPPING[kind]()
    name = type(later).__name__
    if kind in refused:
        with pytest.raises(ValueError, match=f"{name} comes after {type(make()).__name__} and"):
            chain(make(), later).reset()
        appended = chain(make())
        appended.reset()
        appended.append_transform(STEPPING[kind]())
        with pytest.raises(ValueError, match=f"put {name} before"):
            appended.reset()
    else:
        chain(make(), later).reset()
    chain(STEPPING[kind](), make()).reset()
    TransformedEnv(chain(make()), STEPPING[kind](), auto_unwrap=False).reset()


@pytest.mark.parametrize("make", [lambda: ActuatorBias(0.1), lambda: ActionNoise(0.1)])
@pytest.mark.parametrize("auto_unwrap", [False, True])
def test_a_controller_inside_is_refused(make, auto_unwrap):
    inside = TransformedEnv(BatchedMujocoEnv("inverted_pendulum", 2), OracleTransform())
    outside = TransformedEnv(inside, make(), auto_unwrap=auto_unwrap)
    with pytest.raises(ValueError, match=r"comes after OracleTransform and so .*: put A"):
        outside.reset()
    model = ActionJacobian(lambda x, u: x + u)
    inside = TransformedEnv(BatchedMujocoEnv("inverted_pendulum", 2), L1Transform(model))
    with pytest.raises(ValueError, match="comes after L1Transform"):
        TransformedEnv(inside, make(), auto_unwrap=auto_unwrap).reset()
    TransformedEnv(inside, ObservationNoise(0.0), auto_unwrap=False).reset()
    many = SerialEnv(2, lambda: TransformedEnv(Echo((1,)), OracleTransform()))
    with pytest.raises(ValueError, match="comes after OracleTransform"):
        TransformedEnv(many, make()).reset()


def test_a_controller_inside_counts_by_its_action():
    base = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)
    both = Composite(action=base.action_spec.clone(), other=base.action_spec.clone(), shape=[2])
    base.action_spec = both
    env = TransformedEnv(base, Compose(OracleTransform(), ActuatorBias(0.5, "other")))
    env.rollout(2)
    renamed = RenameTransform([], [], ["action"], ["asked"])
    chain = OracleTransform(), renamed, ActuatorBias(0.5, "asked")
    with pytest.raises(ValueError, match="ActuatorBias comes after OracleTransform"):
        TransformedEnv(BatchedMujocoEnv("inverted_pendulum", 2), Compose(*chain)).reset()


@pytest.mark.parametrize("rows", [[True, False], [False, False]])
def test_a_step_that_is_skipped_changes_no_state(rows):
    stepped = torch.tensor(rows).unsqueeze(-1)
    never = torch.zeros_like(stepped)
    for order in (1, -1):
        decisions = iter([never, ~stepped, never, never])
        skip = ConditionalSkip(lambda _, decisions=decisions: next(decisions))
        env = TransformedEnv(Echo((2,), 1), Compose(*[skip, ActuatorDelay(1)][::order]))
        state, received = env.reset(), []
        for sent in (0.1, 0.2, 0.3, 0.4):
            data = env.step(state.set("action", torch.full((2, 1), sent).double()))
            received.append(data["next", "observation"][:, 0])
            state = env.step_mdp(data)
        expected = [0.2 if row else 0.1 for row in rows]
        assert received[2].tolist() == pytest.approx(expected)
        assert received[3].tolist() == pytest.approx([0.3, 0.3])


def test_the_mask_of_a_reset_may_be_nested():
    env = TransformedEnv(EchoOfAgents(), StepBias(0.5, at=2))
    env.reset()
    zero = torch.zeros(3, 2, dtype=torch.float64)
    for _ in range(2):
        assert not send(env, zero).any()
    mask = torch.tensor([[False, False], [False, True], [False, False]]).unsqueeze(-1)
    state = env.full_done_spec.zero().set(("agent", "_reset"), mask)
    env.reset(state)
    assert send(env, zero)[:, 0].tolist() == [0.5, 0.0, 0.5]


def pendulums(*transforms: Transform) -> tuple[TransformedEnv, TensorDict]:
    """Two of TorchRL's own pendulums, which are not batch-locked, and their first state."""
    vector = UnsqueezeTransform(-1, in_keys=["th"], out_keys=["observation"])
    env = TransformedEnv(PendulumEnv(), Compose(vector, *transforms))
    return env, env.reset(env.base_env.gen_params(batch_size=[2]), set_state=True)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SineBias(0.5),
        lambda: StepBias(0.5, at=1),
        lambda: ActuatorDelay(1),
        lambda: SensorDelay(1),
        lambda: SensorDropout(0.5),
    ],
)
def test_steps_left_out_where_the_batch_is_not_locked_are_refused(make):
    skip = ConditionalSkip(lambda data: torch.tensor([True, False]))
    env, state = pendulums(skip, transform := make())
    with pytest.raises(ValueError, match=rf"{type(transform).__name__} .*steps cannot be left out"):
        env.rollout(3, auto_reset=False, tensordict=state)
    env, state = pendulums(make())
    env.step(env.rand_action(state))
    with pytest.raises(ValueError, match=r"batch \(2,\), but \(1,\) steps.* not batch-locked"):
        env.step(env.rand_action(state[:1]))
    # Another number of environments may begin.
    three = env.reset(env.base_env.gen_params(batch_size=[3]), set_state=True)
    env.rollout(3, auto_reset=False, tensordict=three)


def test_frames_around_a_disturbance_are_disturbed_once_each():
    class Sums(Echo):
        def _step(self, tensordict: TensorDict) -> TensorDict:
            received.append(tensordict["action"].flatten().tolist())
            return super()._step(tensordict)

    received: list[list[float]] = []
    inner = TransformedEnv(Sums((1,)), Compose(ActuatorDelay(1), ActuatorBias(0.5)))
    env = TransformedEnv(inner, FrameSkipTransform(3), auto_unwrap=False)
    env.reset()
    send(env, torch.full((1, 2), 0.25).double())
    assert received == [[0.0, 0.0], [0.75, 0.75], [0.75, 0.75]]


def test_copies_have_a_state_of_their_own():
    env = TransformedEnv(Echo(), WalkBias(0.1))
    env.reset()
    zero = torch.zeros(3, 2, dtype=torch.float64)
    twin = copy.deepcopy(env)
    send(twin, zero)
    assert (send(env, zero) == 0).all() and (send(twin, zero) != 0).all()


@pytest.mark.parametrize(
    "draw",
    [
        lambda shape: torch.tensor(0.3),
        lambda shape: torch.rand(shape[:-1]),
        lambda shape: torch.full(shape, torch.nan),
    ],
)
def test_draws_that_fit_no_environment_are_refused(draw):
    with pytest.raises(ValueError, match="ActuatorBias drew values of shape"):
        TransformedEnv(Echo((2,), 2), ActuatorBias(draw)).reset()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SineBias(0.1, period=0), "period must be positive"),
        (lambda: StepBias(0.1, at=-1), "at must not be negative"),
        (lambda: WalkBias(-0.1), "deviation must not be negative"),
        (lambda: DeadZone(-0.1), "width must not be negative"),
        (lambda: Stiction(-0.1), "band must not be negative"),
        (lambda: ActuatorDelay(0.5), "steps must be whole"),
        (lambda: ActuatorDelay(float("inf")), "finite number"),
    ],
)
def test_values_that_cannot_be(make, message):
    with pytest.raises(ValueError, match=message):
        make()
