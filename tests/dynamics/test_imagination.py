from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs
from torchrl.modules import CEMPlanner
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torchrl_l1.dynamics import EnsembleDynamics, EnsembleModelEnv, imagine, make_dynamics

Policy = Callable[[Tensor], Tensor]

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


def test_the_environment_ends_where_the_task_does_and_is_cut_off_where_the_model_does() -> None:
    def rollout(**settings: Any) -> TensorDict:
        start = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
        env = EnsembleModelEnv(
            drifting_model(2.5), reward, lambda count: start, -1.0, 1.0, (2,), **settings
        )
        check_env_specs(env)
        ones = torch.ones(2, 1)
        data = env.rollout(9, lambda td: td.set("action", ones), break_when_any_done=False)
        return data["next"].select("done", "terminated", "truncated")[:, :3]

    ends = rollout(box_exit="truncate")
    assert ends["truncated"][..., 0].int().tolist() == [[0, 0, 1], [0, 1, 0]]
    assert not ends["terminated"].any() and torch.equal(ends["done"], ends["truncated"])
    ends = rollout()
    assert torch.equal(ends["done"], ends["terminated"]) and ends["done"].any()
    ends = rollout(terminated=lambda successor: successor[..., 0] > 1.5, box_exit="truncate")
    assert ends["terminated"][..., 0].int().tolist() == [[0, 1, 0], [1, 1, 1]]
    assert not ends["truncated"].any()
    with pytest.raises(ValueError, match="box_exit must be 'fail' or 'truncate'"):
        rollout(box_exit="stop")


def test_specs_are_of_the_model_s_type() -> None:
    model = drifting_model(2.5).double()
    env = EnsembleModelEnv(
        model, lambda x, u, s: s[..., 0] > 1, lambda n: torch.zeros(n, 2), -1.0, 1.0, (4,)
    )
    check_env_specs(env)
    data = env.rollout(3, lambda td: td.set("action", torch.ones(4, 1).double()))
    assert data["next", "reward"].dtype == data["observation"].dtype == torch.float64
    assert data["next", "reward"][0, :, 0].tolist() == [0.0, 1.0, 1.0]


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


def fitted_model(head: str = "deterministic", form: str = "nonlinear") -> EnsembleDynamics:
    torch.manual_seed(0)
    model = make_dynamics(3, 2, form, hidden=(32, 24), members=4, activation="silu", head=head)
    model.fit_statistics(3 + torch.randn(50, 3), 2 * torch.randn(50, 2), 0.3 * torch.randn(50, 3))
    model.box.low.fill_(2.4)
    model.box.high.fill_(3.6)
    model.set_elites([1, 3])
    return model


def stepwise(model: EnsembleDynamics, policy: Policy, start: Tensor, steps: int) -> list[Tensor]:
    """Observations, actions, rewards and whether inside, by the definition, step by step."""
    elites = model.elites.tolist()
    drawn = [elites[i] for i in torch.randint(len(elites), (steps,)).tolist()]
    x, columns = start, []
    for member in drawn:
        action = policy(x)
        successor = x + model.member_change(x, action.clamp(-1, 1), member)
        inside = model.box.contains(successor)
        successor = torch.where(inside[:, None], successor, x)
        columns.append((x, action, quadratic(x, action.clamp(-1, 1), successor), inside))
        x = successor
    return [torch.stack(column, 1) for column in zip(*columns, strict=True)]


def quadratic(x: Tensor, u: Tensor, successor: Tensor) -> Tensor:
    return successor.square().sum(-1) + x[..., 0] * u.square().sum(-1)


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
def test_is_the_definition_step_by_step(head: str, form: str) -> None:
    model = fitted_model(head, form)
    gain, start = torch.randn(3, 2), 3 + 0.2 * torch.randn(40, 3)
    bound = torch.ones(2)

    def policy(x: Tensor) -> Tensor:
        return x @ gain + torch.randn(40, 2)

    with torch.no_grad():
        torch.manual_seed(5)
        expected = stepwise(model, policy, start, 12)
        torch.manual_seed(5)
        found = imagine(model, policy, quadratic, start, 12, -bound, bound)
    valid = found["valid"][..., 0]
    ended = (~expected[3]).long()
    assert torch.equal(valid, (ended.cumsum(1) - ended) == 0)
    assert 0 < found["next", "left_box"].sum() < 40
    pairs = [found["observation"], found["action"], found["next", "reward"][..., 0]]
    for one, other in zip(pairs, expected[:3], strict=True):
        torch.testing.assert_close(one[valid], other[valid], rtol=1e-4, atol=1e-5)
        assert one.isfinite().all()


def test_nothing_broken_outlives_the_box() -> None:
    model = drifting_model(1e30)
    with torch.no_grad():
        model.network.weights[0][:, 2, 0] = torch.nan
    found = imagine(
        model,
        lambda x: x[:, :1] + 0.5,
        reward,
        torch.zeros(3, 2),
        4,
        LOW,
        HIGH,
        lambda x: x[:, 0] > 9,
    )
    assert found["valid"].sum() == found["next", "left_box"].sum() == 3
    for key in ("observation", "action", ("next", "reward"), ("next", "observation")):
        assert found[key].isfinite().all()


def test_hidden_layers_in_bfloat16_stay_close() -> None:
    model, bound = fitted_model(), torch.ones(2)
    start = 3 + 0.1 * torch.randn(40, 3)
    paths = []
    for precision in ("float32", "bfloat16"):
        torch.manual_seed(1)
        paths.append(
            imagine(
                model,
                lambda x: torch.randn(40, 2),
                quadratic,
                start,
                4,
                -bound,
                bound,
                precision=precision,  # type: ignore[arg-type]
            )["observation"]
        )
    moved = (paths[0] - start[:, None]).abs().mean()
    assert 0 < (paths[0] - paths[1]).abs().mean() < 0.02 * moved


def test_entries_that_never_varied_end_nothing() -> None:
    torch.manual_seed(0)
    model, x = EnsembleDynamics(3, 1, members=3, hidden=(16,)), torch.randn(50, 3)
    x[:, 1] = 5.0
    change = 0.1 * torch.randn(50, 3)
    change[:, 1] = 0.0
    model.fit_statistics(x, torch.randn(50, 1), change)
    # The model errs there, as every network does, and the box is a single number wide.
    assert (model.mean_change(x, torch.zeros(50, 1))[:, 1] != 0).all()
    model.box.low[[0, 2]], model.box.high[[0, 2]] = -1e3, 1e3
    found = imagine(
        model, lambda o: torch.randn(50, 1), quadratic, x, 20, LOW, HIGH, lambda o: o[:, 1].float()
    )
    assert found["next", "terminated"][:, 0].all()  # a flag of any type is one
    found = imagine(model, lambda o: torch.randn(50, 1), quadratic, x, 20, LOW, HIGH)
    assert found["valid"].all() and not found["next", "left_box"].any()
    assert (found["next", "observation"][..., 1] == 5).all()
    # Who starts elsewhere is outside from the first step on.
    found = imagine(model, lambda o: torch.randn(50, 1), quadratic, x + 1, 20, LOW, HIGH)
    assert found["next", "left_box"][:, 0].all()
    env = EnsembleModelEnv(model, quadratic, lambda count: x[:count], -1.0, 1.0, (4,))
    data = env.rollout(20)
    assert data.shape == (4, 20) and (data["next", "observation"][..., 1] == 5).all()
    model.change_normalizer.mean[1] = torch.nan
    assert imagine(model, lambda o: o[:, :1], quadratic, x, 9, LOW, HIGH)["valid"].sum() == 50


def test_what_is_no_number_per_row_is_named() -> None:
    model, start = drifting_model(9.0), torch.zeros(3, 2)

    def go(
        reward: Callable[..., object] = reward,
        terminated: Callable[[Tensor], object] | None = None,
        start: Tensor = start,
        horizon: int = 4,
    ) -> None:
        imagine(model, lambda x: x[:, :1], reward, start, horizon, LOW, HIGH, terminated)  # type: ignore[arg-type]

    for wrong in (lambda *parts: parts[0][:, :1], lambda *parts: parts[0].mean(), lambda *parts: 1):
        with pytest.raises(ValueError, match=r"the reward function must return shape"):
            go(wrong)
    with pytest.raises(ValueError, match=r"the terminated function must .* got \(12, 1\)"):
        go(terminated=lambda successor: successor[:, :1] > 0)
    with pytest.raises(ValueError, match=r"start must have shape \(B, 2\)"):
        go(start=start[0])
    with pytest.raises(ValueError, match="horizon must be at least 1"):
        go(horizon=0)


def test_actions_and_bounds_that_do_not_fit_are_named() -> None:
    model, start = EnsembleDynamics(2, 3, members=2, hidden=(4,)), torch.zeros(3, 2)
    low, high = -torch.ones(3), torch.ones(3)
    for wrong in (torch.zeros(3, 1), torch.zeros(3), torch.zeros(1, 3)):
        with pytest.raises(ValueError, match=r"policy must give actions \(3, 3\) for .*, got"):
            imagine(model, lambda x, wrong=wrong: wrong, reward, start, 2, low, high)
    for bounds, message in (
        ((high, low), "bounds are empty"),
        ((low, high[:2]), r"high has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            imagine(model, lambda x: torch.zeros(3, 3), reward, start, 2, *bounds)
    infinite = torch.full((3,), torch.inf)  # which is no clipping
    found = imagine(model, lambda x: 9 + torch.zeros(3, 3), reward, start, 2, -infinite, infinite)
    assert found.shape == (3, 2)
    largest = torch.finfo(torch.float32).max
    for bounds, message in (
        ((-1.0, torch.inf), "bound high must be finite"),
        ((-largest, largest), "bound low must be finite"),
        ((1.0, -1.0), "bounds are empty"),
        ((-1.0, torch.ones(2)), "high has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            EnsembleModelEnv(model, reward, lambda n: torch.zeros(n, 2), *bounds)
    env = EnsembleModelEnv(model, reward, lambda n: torch.zeros(2, n), -1.0, 1.0, (4,))
    with pytest.raises(
        ValueError, match=r"start\(4\) must give observations \(4, 2\), got \(2, 4\)"
    ):
        env.reset()


@pytest.mark.parametrize("value", [torch.nan, -torch.inf])
def test_a_reward_that_is_no_number_after_the_end_is_none_before_it(value: float) -> None:
    def breaks(x: Tensor, u: Tensor, successor: Tensor) -> Tensor:
        return torch.where(successor[:, 0] > 2.5, value, successor[:, 0])

    found = imagine(
        drifting_model(100.0),
        lambda x: torch.ones(1, 1),
        breaks,
        torch.zeros(1, 2),
        5,
        LOW,
        HIGH,
        lambda successor: successor[:, 0] > 1.5,
    )
    assert found["next", "reward"][0, :, 0].tolist() == [1.0, 2.0, 0.0, 0.0, 0.0]
    advantage, _ = generalized_advantage_estimate(
        0.5,
        1.0,
        torch.zeros(1, 5, 1),
        torch.zeros(1, 5, 1),
        *(found["next", key] for key in ("reward", "done", "terminated")),
    )
    assert advantage[0, :2, 0].tolist() == [2.0, 2.0]


def test_the_environment_earns_what_imagination_does_where_it_ends() -> None:
    def diverging(x: Tensor, u: Tensor, successor: Tensor) -> Tensor:
        return torch.where(successor[..., 0] > 2.5, torch.nan, successor[..., 0])

    model, ones = drifting_model(2.5), torch.ones(1, 1)
    env = EnsembleModelEnv(model, diverging, lambda n: torch.zeros(n, 2), -1.0, 1.0, (1,))
    data = env.rollout(9, lambda td: td.set("action", ones))
    other = imagine(model, lambda x: ones, diverging, torch.zeros(1, 2), 3, LOW, HIGH)
    assert data["next", "reward"][0, :, 0].tolist() == [1.0, 2.0, 2.0]
    assert torch.equal(data["next", "reward"], other["next", "reward"])


def test_bounds_of_each_entry_of_the_action() -> None:
    model = EnsembleDynamics(2, 3, members=2, hidden=(4,))
    low, high = torch.tensor([-1.0, 0.0, -5.0]), [1.0, 2.0, -4.0]
    env = EnsembleModelEnv(model, reward, lambda n: torch.zeros(n, 2), low, high, (50,))
    check_env_specs(env)
    action = env.rollout(1)["action"]
    for entry in range(3):
        assert low[entry] <= action[..., entry].min() < action[..., entry].max() <= high[entry]


@pytest.mark.parametrize("name", ["policy", "reward", "terminated"])
def test_a_function_that_writes_to_what_it_is_given_is_named(name: str) -> None:
    functions: dict[str, Callable[..., Tensor]] = {
        "policy": lambda x: torch.zeros(2, 1),
        "reward": reward,
        "terminated": lambda successor: successor[..., 0] > 9,
    }
    given = functions[name]

    def writes(*inputs: Tensor) -> Tensor:
        inputs[-1][..., 0] -= 100.0
        return given(*inputs)

    functions[name] = writes
    start = torch.zeros(2, 2)
    with pytest.raises(ValueError, match=f"the {name} function writes to its inputs"):
        imagine(drifting_model(9.0), start=start, horizon=2, action_low=LOW, action_high=HIGH,
                **functions)  # fmt: skip


def test_functions_in_inference_mode_are_called_all_the_same() -> None:
    with torch.inference_mode():
        found = imagine(
            drifting_model(9.0), lambda x: x[:, :1] + 1, reward, torch.zeros(2, 2), 2, LOW, HIGH
        )
    assert found["observation"][0, :, 0].tolist() == [0.0, 1.0]


def test_the_environment_clips_actions_as_imagine_does() -> None:
    env = EnsembleModelEnv(
        drifting_model(9.0), reward, lambda count: torch.zeros(count, 2), -1.0, 1.0, (3,)
    )
    found = env.rollout(4, lambda td: td.set("action", torch.full((3, 1), 5.0)))
    expected = imagine(
        drifting_model(9.0), lambda x: torch.full((3, 1), 5.0), reward, torch.zeros(3, 2), 4, LOW,
        HIGH,
    )  # fmt: skip
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        torch.testing.assert_close(found[key], expected[key])


def test_a_reward_of_another_shape_is_named_by_the_environment() -> None:
    env = EnsembleModelEnv(
        drifting_model(9.0), lambda x, u, successor: u * x[..., 0], lambda n: torch.zeros(n, 2),
        -1.0, 1.0, (2,),
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"the reward function must return .* got \(2, 2\)"):
        env.rollout(2)
