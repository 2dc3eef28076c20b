from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import NonTensorStack, TensorDict, lazy_stack
from torch import nn
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, ListStorage, ReplayBuffer
from torchrl.envs import GymEnv, MultiStepTransform, SerialEnv, StepCounter, TransformedEnv

from torchrl_l1.dynamics import (
    EnsembleDynamics,
    FitConfig,
    fit_dynamics,
    fit_ensemble,
    read_transitions,
)


def line(*lengths: int, offset: float = 0.0) -> TensorDict:
    """Episodes ``[N]`` of a counter; no two of them hold the same number."""
    parts = []
    for episode, length in enumerate(lengths):
        count = offset + 1000.0 * episode + torch.arange(length + 1)[:, None]
        done = torch.zeros(length, 1, dtype=torch.bool)
        done[-1] = True
        parts.append(
            TensorDict(
                {
                    "observation": count[:-1],
                    "action": torch.ones(length, 1),
                    "next": {"observation": count[1:], "done": done},
                },
                batch_size=[length],
            )
        )
    return torch.cat(parts)


def wide(length: int) -> TensorDict:
    data = line(length)
    for key in ("observation", ("next", "observation")):
        data[key] = data[key].expand(length, 2)
    return data


def labelled(data: TensorDict, ids: object) -> TensorDict:
    return data.set("traj_ids", ids)


def buffer(data: TensorDict, ndim: int = 1) -> ReplayBuffer:
    made = ReplayBuffer(storage=LazyTensorStorage(1000, ndim=ndim))
    made.extend(data)
    return made


def kept(data: object, **options: object) -> list[float]:
    return sorted(read_transitions(data, **options).data["observation"].squeeze(-1).tolist())


def test_all_that_torchrl_makes_of_the_same_steps_reads_alike() -> None:
    env = SerialEnv(3, lambda: TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(20)))
    env.set_seed(0)
    torch.manual_seed(0)
    (data,) = Collector(env, None, frames_per_batch=150, total_frames=150)
    flat = data.reshape(-1)
    shapes = {
        "batched": data,
        "time first": data.transpose(0, 1),
        "flat": flat,
        "several": list(data.unbind(0)),
        "buffer": buffer(flat),
        "buffer of trajectories": buffer(data),
        "buffer with time": buffer(data, ndim=2),
        "padded": split_trajectories(data.clone()),
    }
    lists = ReplayBuffer(storage=ListStorage(1000))
    lists.extend(flat)
    shapes["list"] = lists
    expected = read_transitions(data)
    for name, shape in shapes.items():
        read = read_transitions(shape)
        assert read.dropped == 0, name
        order, other = (one.data["observation"][:, 2].argsort() for one in (read, expected))
        for key in ("observation", "action", ("next", "observation")):
            assert torch.equal(read.data[key][order], expected.data[key][other]), name
        # 150 rows end thrice for the batch and twice in each environment for the time limit.
        assert int((~read.joined).sum()) == 9, name


def test_a_lazy_stack_of_different_lengths() -> None:
    one, other = line(4), line(7, offset=100)
    expected = read_transitions([one, other])
    for data in (lazy_stack([one, other]), lazy_stack([lazy_stack([one, other])])):
        assert -1 in data.shape
        found = read_transitions(data)
        assert (found.data == expected.data).all()
        assert torch.equal(found.joined, expected.joined) and found.dropped == 0
    pairs = lazy_stack([torch.stack([line(4)] * 3), torch.stack([line(7)] * 3)])
    assert len(read_transitions(pairs).data) == 3 * 4 + 3 * 7


def test_trajectories_are_never_torn_where_there_are_enough() -> None:
    data = line(*[7] * 40)
    read = read_transitions(data, validation_fraction=0.2)
    held_out = read.validation.view(40, 7)
    assert (held_out.all(1) | ~held_out.any(1)).all() and held_out.any(1).sum() == 8
    assert torch.equal(read.validation, read_transitions(data, validation_fraction=0.2).validation)
    other = read_transitions(data, validation_fraction=0.2, seed=1).validation
    assert not torch.equal(read.validation, other)
    same = read_transitions(data, validation_fraction=0.2, seed=np.int64(1)).validation
    assert torch.equal(other, same)


def test_trajectories_that_are_named_stay_whole_when_shuffled() -> None:
    data = line(*[7] * 40)
    data["collector", "traj_ids"] = torch.arange(40).repeat_interleave(7)
    order = torch.randperm(280)
    read = read_transitions(data[order], validation_fraction=0.2)
    ids = data["collector", "traj_ids"][order]
    assert not set(ids[read.validation].tolist()) & set(ids[~read.validation].tolist())
    assert read.validation.sum() == 56


def test_a_long_trajectory_is_cut() -> None:
    held_out = read_transitions(line(2000), validation_fraction=0.2).validation
    pieces = held_out.view(-1, 100)
    assert held_out.sum() == 400 and (pieces.all(1) | ~pieces.any(1)).all()
    short = read_transitions(line(200), validation_fraction=0.1).validation
    assert short.sum() == 20 and short.view(-1, 20).all(1).sum() == 1


@given(
    st.lists(st.integers(1, 60), min_size=1, max_size=12),
    st.floats(0.01, 0.99),
    st.integers(0, 5),
)
def test_there_is_always_something_on_both_sides(
    lengths: list[int], fraction: float, seed: int
) -> None:
    read = read_transitions(line(*lengths), validation_fraction=fraction, seed=seed)
    rows = len(read.validation)
    assert rows == sum(lengths)
    if rows > 1:
        assert read.validation.any() and not read.validation.all()
    wanted = max(1, round(fraction * rows))
    # What is drawn last may reach beyond.
    assert read.validation.sum() < wanted + min(wanted, max(lengths), 100) + 1


def test_a_flag_is_obeyed_and_one_that_is_never_true_is_none() -> None:
    data = line(20, 20)
    data["validation"] = torch.arange(40)[:, None] % 3 == 0
    assert torch.equal(read_transitions(data).validation, data["validation"].squeeze(-1))
    data["validation"] = torch.zeros(40, dtype=torch.bool)
    assert read_transitions(data).validation.sum() == 4


def test_what_is_not_finite_is_left_out_and_counted() -> None:
    data = line(10, 10)
    data["observation"][3] = torch.nan
    data["action"][5] = torch.inf
    data["next", "observation"][5] = torch.nan
    with pytest.warns(
        UserWarning,
        match=r"dropped 2 of 20 transitions .* 1 in 'observation', 1 in 'action', 1 in \('next', ",
    ):
        read = read_transitions(data)
    assert read.dropped == 2 and len(read.data) == 18
    assert (~read.joined).nonzero().flatten().tolist() == [2, 3, 7, 17]


def test_padding_and_what_follows_an_end_are_left_out_without_a_word() -> None:
    data = line(4, 4)
    data["mask"] = torch.tensor([1, 1, 0, 0, 1, 1, 1, 1], dtype=torch.bool)
    data["action"][2] = torch.nan
    data["done"] = torch.zeros(8, 1, dtype=torch.bool)
    data["done"][7] = True
    assert kept(data) == [0, 1, 1000, 1001, 1002]


@pytest.mark.parametrize("mode", ["SAME_STEP", "NEXT_STEP"])
def test_no_transition_leads_across_a_reset(mode: str) -> None:
    """A vectorised environment that resets itself, recorded as one does without TorchRL."""
    env = gymnasium.make_vec(
        "InvertedPendulum-v5",
        3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": gymnasium.vector.AutoresetMode[mode]},
    )
    env.action_space.seed(0)
    seen, _ = env.reset(seed=0)
    steps = []
    for _ in range(60):
        action = env.action_space.sample()
        following, _, terminated, truncated, _ = env.step(action)
        steps.append((seen, action, following, terminated | truncated))
        seen = following
    env.close()
    x, u, after, done = (torch.stack([torch.as_tensor(s[i]) for s in steps], 1) for i in range(4))
    data = TensorDict(
        {"observation": x, "action": u, "next": {"observation": after, "done": done[..., None]}},
        batch_size=[3, 60],
    )
    assert done.sum() > 10
    with pytest.warns(UserWarning, match=r"transitions at resets: \('next', 'observation'\)"):
        read = read_transitions(data)
    # The pole falls off at 0.2 rad; no single step moves it by a tenth of that but back.
    angle, later = read.data["observation"][:, 1], read.data["next", "observation"][:, 1]
    physical = read.data["observation"][:, 3] * 0.04
    assert (later - angle - physical).abs().max() < 0.1
    assert 2 * done.sum() >= read.dropped >= done[:, :-1].sum()
    # Where the steps belong is known, nothing is suspected.
    data["collector", "traj_ids"] = torch.zeros(3, 60, dtype=torch.long)
    assert read_transitions(data).dropped == 0


def test_a_batch_that_a_collector_cuts_off_is_no_reset() -> None:
    env = TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(50))
    collector = Collector(env, None, frames_per_batch=30, total_frames=120, set_truncated=True)
    data = torch.cat([part.clone() for part in collector])
    assert read_transitions(data).dropped == 0
    del data["collector"]
    with pytest.warns(UserWarning, match="at resets"):
        assert read_transitions(data).dropped > 0


def test_what_nothing_says_of_ends_is_told_by_continuity() -> None:
    data = line(5, 5)
    data["done"] = data["next", "done"]
    del data["next", "done"]
    assert (~read_transitions(data).joined).nonzero().flatten().tolist() == [4, 9]
    assert (~read_transitions(data.exclude("done")).joined).sum() == 2
    data["observation"][5:], data["next", "observation"][5:] = 5.0, 6.0
    assert (~read_transitions(data.exclude("done")).joined).nonzero().min() == 5


def test_other_keys() -> None:
    data = TensorDict(
        {
            "state": {"joints": torch.randn(6, 3)},
            "agent": {"torque": torch.randn(6, 2)},
            "next": {"state": {"joints": torch.randn(6, 3)}},
        },
        batch_size=[6],
    )
    read = read_transitions(data, ("state", "joints"), ("agent", "torque"))
    assert torch.equal(read.data["next", "observation"], data["next", "state", "joints"])


@pytest.mark.parametrize(
    ("change", "options", "error", "message"),
    [
        (lambda d: d.pop("action"), {}, KeyError, "no 'action', only .*'observation'.* action_key"),
        (lambda d: d, {"observation_key": "obs"}, KeyError, "no 'obs', only .* observation_key"),
        (
            lambda d: d["next"].pop("observation"),
            {},
            KeyError,
            r"no \('next', 'observation'\), only 'action', .*observation_key.*one row later",
        ),
        (
            lambda d: d.set("action", torch.zeros(20)),
            {},
            ValueError,
            r"'action' has shape \[20\] for a batch size of \[20\], expected \[20, 'n'\]",
        ),
        (
            lambda d: d.set("observation", torch.zeros(20, 3, 8, 8)),
            {},
            ValueError,
            r"'observation' has shape \[20, 3, 8, 8\]",
        ),
        (
            lambda d: d.set("observation", torch.zeros(20, 2)),
            {},
            ValueError,
            r"'observation' has 2 entries, \('next', 'observation'\) 1",
        ),
        (
            lambda d: d.set("action", torch.zeros(20, 1, dtype=torch.complex64)),
            {},
            ValueError,
            "'action' is torch.complex64",
        ),
    ],
)
def test_errors_name_the_key_and_what_is_there(
    change: object, options: dict[str, str], error: type[Exception], message: str
) -> None:
    data = line(10, 10)
    change(data)
    with pytest.raises(error, match=message) as caught:
        read_transitions(data, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        (line(3)[0], ValueError, r"batch size \[\]"),
        ({"observation": 1}, TypeError, "tensordict, several of them or a ReplayBuffer .* dict: "),
        ("log.csv", TypeError, "got str: .* read_csv and read_npz of tables"),
        ([line(3), wide(3)], ValueError, "observations of widths 1, 2 in their parts"),
        (labelled(line(4), torch.zeros(4, 2)), ValueError, "'traj_ids' holds 8 numbers for 4 tran"),
        ([torch.zeros(3)], TypeError, "got Tensor"),
    ],
)
def test_other_data_are_refused(data: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        read_transitions(data)


@pytest.mark.parametrize(
    "ids",
    [
        torch.tensor([0.2, 0.2, 0.7, 0.7]),
        torch.tensor([[-3], [-3], [2**40], [2**40]]),
        NonTensorStack("a", "a", "b", "b"),
    ],
)
def test_trajectories_may_have_any_names(ids: object) -> None:
    read = read_transitions(labelled(line(4).exclude(("next", "done")), ids))
    assert read.joined.tolist() == [True, False, True, False]


def test_rows_with_a_flag_are_taken_as_they_are() -> None:
    """The loops of the algorithms: what is fitted is what was fitted before data were read."""
    torch.manual_seed(0)
    data = TensorDict(
        {"observation": torch.randn(50, 3), "action": torch.randn(50, 1)}, batch_size=[50]
    )
    data["next", "observation"] = torch.randn(50, 3)
    data["validation"] = torch.rand(50) < 0.2
    state = torch.get_rng_state()
    read = read_transitions(buffer(data))
    assert torch.equal(torch.get_rng_state(), state)
    for mask in (read.validation, ~read.validation):
        flag = data["validation"] if mask is read.validation else ~data["validation"]
        for key in ("observation", "action", ("next", "observation")):
            assert torch.equal(read.data[mask][key], data[flag][key])


def test_memory_maps_and_gradients(tmp_path: Path) -> None:
    data = line(30, 30)
    data.memmap(tmp_path / "data")
    loaded = TensorDict.load_memmap(tmp_path / "data")
    assert kept(loaded) == kept(data)
    policy = nn.Linear(1, 1)
    data["action"] = policy(data["observation"])
    model = EnsembleDynamics(1, 1, members=2, hidden=(4,))
    optimizer = torch.optim.Adam(model.parameters())
    report = fit_ensemble(model, data, FitConfig(max_epochs=2), optimizer)
    assert report.epochs == 2 and policy.weight.grad is None


def test_what_a_batched_mujoco_environment_collects() -> None:
    env = SerialEnv(2, partial(GymEnv, "InvertedPendulum-v5"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (data,) = Collector(env, None, frames_per_batch=200, total_frames=200)
        read = read_transitions(data)
    assert data.shape == (2, 100) and data["observation"].dtype is torch.float64
    assert len(read.data) == 200 and read.data["observation"].dtype is torch.float32
    assert int((~read.joined).sum()) == int(data["next", "done"][:, :-1].sum()) + 2


@pytest.mark.parametrize("offset", [0.0, 1e3, 5e6])
def test_changes_lost_in_the_digits_of_large_values_are_told(offset: float) -> None:
    torch.manual_seed(0)
    x, u = torch.randn(200, 2, dtype=torch.float64), torch.randn(200, 1, dtype=torch.float64)
    after = 0.9 * x + 0.1 * u
    x, after = (value + torch.tensor([0.0, offset]) for value in (x, after))
    data = TensorDict({"seen": x, "action": u, ("next", "seen"): after}, [200])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fit_dynamics(data, observation_key="seen", hidden=(8,), max_epochs=1)
    digits = [str(one.message) for one in told if "per step" in str(one.message)]
    assert [message[:22] for message in digits] == ["'seen'[1] changes by 0"] * (offset == 5e6)


@pytest.mark.parametrize(
    ("of_x", "of_u", "told"),
    [
        (1.0, 1.0, []),
        (1e-7, 1.0, ["'observation'[0] changes", "'observation'[1] changes"]),
        (1.0, 1e-6, ["'action'[0] varies"]),
    ],
)
def test_units_that_are_too_large_for_the_model_are_told(
    of_x: float, of_u: float, told: list[str]
) -> None:
    """A micrometre in metres is no constant, and no want of data."""
    torch.manual_seed(0)
    x, u = torch.randn(500, 2), torch.randn(500, 1)
    change = 0.3 * torch.cat([x[:, 1:], u], -1)
    data = TensorDict({"observation": of_x * x, "action": of_u * u}, [500])
    data["next", "observation"] = of_x * (x + change)

    def fitted(**settings: float) -> tuple[list[str], float]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model = fit_dynamics(data, hidden=(32,), batch_size=64, max_epochs=100, **settings)
        assert model.quality is not None
        return [str(one.message) for one in caught], min(model.quality.explained)

    messages, explained = fitted()
    small = [message for message in messages if "std_floor" in message]
    assert [message.partition(" by")[0] for message in small] == told
    if told:
        assert explained < 0.8
        floor = min(float(message.rpartition(" ")[2]) for message in small)
        messages, explained = fitted(std_floor=floor)
    assert not messages and explained > 0.95


def test_inputs_that_never_vary_are_ignored_and_told() -> None:
    torch.manual_seed(0)
    x, u = torch.randn(500, 3), torch.randn(500, 2)
    x[:, 2], u[:, 1] = 5.0, 0.3
    change = torch.cat([0.1 * u[:, :1] - 0.1 * x[:, :2], torch.zeros(500, 1)], -1)
    data = TensorDict({"observation": x, "action": u, ("next", "observation"): x + change}, [500])
    with pytest.warns(UserWarning, match=r"'action'\[1\] never varies, so its effect is not in"):
        model = fit_dynamics(data, hidden=(64,))
    seen, other = x[:5], x[:5] + torch.tensor([0.0, 0.0, 2.0])
    pushed = u[:5] + torch.tensor([0.0, 0.7])
    expected, gain = model.value_and_jacobian(seen, u[:5])
    for observation, action in ((other, u[:5]), (seen, pushed), (other, pushed)):
        torch.testing.assert_close(model.value_and_jacobian(observation, action), (expected, gain))
    torch.testing.assert_close(gain[:, :2, 0], torch.full((5, 2), 0.1), rtol=0.0, atol=0.05)
    assert (gain[..., 1] == 0).all()


def test_steps_of_several_are_refused() -> None:
    """MultiStep writes what followed three steps later: a plant three times as fast."""
    made = ReplayBuffer(
        storage=LazyTensorStorage(100), transform=MultiStepTransform(n_steps=3, gamma=0.9)
    )
    made.extend(line(10).set(("next", "reward"), torch.ones(10, 1)))
    gaps = made[:]["next", "observation"] - made[:]["observation"]
    assert gaps.max() == 3.0
    with pytest.raises(ValueError, match=r"'next', 'observation'\) is up to 3 steps later"):
        read_transitions(made)
