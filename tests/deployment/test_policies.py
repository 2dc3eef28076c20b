from __future__ import annotations

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded, Unbounded
from torchrl.modules import LSTMModule

from torchrl_l1.control import L1Controller
from torchrl_l1.deployment import FunctionPolicy, environment_source, load_policy
from torchrl_l1.deployment.learning import policy_transforms
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.run import run

from .conftest import OBSERVATION, actions, balance


@pytest.mark.parametrize(
    ("function", "rows"),
    [
        (balance, False),
        (lambda x: np.array([np.dot(x.numpy(), [1.0, 10.0, 1.0, 2.0])]), True),
        (lambda x: [float(x[0] + 10 * x[1] + x[2] + 2 * x[3])], True),
        (lambda x: (balance(x), "state"), False),
    ],
    ids=["tensors", "array", "numbers", "with more"],
)
def test_functions_act_on_batches_and_single_observations(env, function, rows):
    policy = load_policy(function, env)
    assert policy.rows is rows
    torch.testing.assert_close(actions(policy, OBSERVATION), balance(OBSERVATION))
    torch.testing.assert_close(actions(policy, OBSERVATION[1]), balance(OBSERVATION[1]))
    assert actions(policy, OBSERVATION[:, None]).shape == (3, 1, 1)
    assert actions(policy, OBSERVATION).dtype == torch.float32


def test_actions_stay_within_the_bounds(env):
    policy = load_policy(lambda x: 100 * balance(x), env)
    assert actions(policy, 10 * OBSERVATION).abs().max() == 3.0


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda x: torch.zeros(7), "expected an action of width 1"),
        (lambda x: x.no_such_thing, "failed at an observation of width 4"),
        (3, "int is not a policy"),
        ("nothing", "unknown policy 'nothing'; policies are sb3"),
        ("math:no_such_name", "no 'no_such_name'"),
    ],
)
def test_what_is_no_policy(env, policy, message):
    with pytest.raises(ValueError, match=message):
        load_policy(policy, env)


@pytest.mark.parametrize("name", ["balance", "make"])
def test_functions_of_files_and_functions_that_return_them(env, policy_file, name):
    policy = load_policy(f"{policy_file}:{name}", env)
    torch.testing.assert_close(actions(policy, OBSERVATION), balance(OBSERVATION))


def test_modules_with_the_weights_of_a_state_dict(env, policy_file, tmp_path):
    module = torch.nn.Linear(4, 1)
    torch.save(module.state_dict(), tmp_path / "weights.pt")
    policy = load_policy(f"{policy_file}:network", env, weights=str(tmp_path / "weights.pt"))
    torch.testing.assert_close(actions(policy, OBSERVATION), module(OBSERVATION))


def test_weights_that_are_pickles_of_objects_are_refused(env, policy_file, tmp_path):
    torch.save(torch.nn.Linear(4, 1), tmp_path / "module.pt")
    with pytest.raises(ValueError, match="holds more than tensors"):
        load_policy(f"{policy_file}:network", env, weights=str(tmp_path / "module.pt"))


@pytest.mark.parametrize(
    "content", [b"", b"root:x:0:0:root:/root:/bin/bash\n", b"\x80\x02t.", b"["]
)
def test_weights_that_are_something_else_are_refused(env, policy_file, tmp_path, content):
    file = tmp_path / "weights.pt"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"weights\.pt is not a state dict"):
        load_policy(f"{policy_file}:network", env, weights=str(file))


def test_torchrl_modules_are_taken_as_they_are(env):
    module = TensorDictModule(balance, ["observation"], ["action"])
    assert load_policy(module, env) is module


def test_run_directories(env, tiny_recipe, tmp_path):
    run(tiny_recipe("outer_iterations=1"))
    policy = load_policy(str(tmp_path / "run"), env)
    (own,) = load_run(tmp_path / "run").algorithm.policies.values()
    with torch.no_grad():
        mean, _ = own.module[0].module(OBSERVATION)
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(actions(policy, OBSERVATION), mean.clamp(-3, 3))


@pytest.mark.parametrize(("bound", "warned"), [(3.0, False), (1.0, True)])
def test_other_bounds_than_the_environments_are_told(env, bound, warned):
    policy = SimpleNamespace(
        squash_output=True,
        observation_space=spaces.Box(-np.inf, np.inf, (4,)),
        action_space=spaces.Box(-bound, bound, (1,)),
        set_training_mode=lambda mode: None,
        _predict=lambda observation, deterministic: observation[..., :1],
    )
    model = SimpleNamespace(policy=policy, predict=len)
    message = r"trained with actions from \[-1.0\] to \[1.0\], the environment takes \[-3.0\] to"
    with pytest.warns(UserWarning, match=message) if warned else warnings.catch_warnings():
        found = load_policy(model, env)
    torch.testing.assert_close(actions(found, OBSERVATION), bound * OBSERVATION[:, :1])


def test_normalization_of_another_policy_is_refused(env):
    with pytest.raises(ValueError, match="belongs to policies of Stable-Baselines3"):
        load_policy(balance, env, normalization="statistics.pkl")


GAIN = np.array([[1.0, 10.0, 1.0, 2.0]], np.float32)


@pytest.mark.parametrize(
    ("function", "rows", "arrays"),
    [
        (lambda x: GAIN @ x, True, True),
        (lambda x: x @ GAIN.T, False, True),
        (lambda x: GAIN @ [x[0], np.tan(np.arctan(x[1])), x[2], x[3]], True, True),
        (lambda x: float(np.dot(GAIN[0], x)), True, True),
    ],
    ids=["row", "batch", "row of parts", "number"],
)
def test_functions_of_arrays(env, function, rows, arrays):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy = load_policy(function, env)
        found = actions(policy, OBSERVATION)
    assert (policy.rows, policy.arrays) == (rows, arrays)
    torch.testing.assert_close(found, balance(OBSERVATION))


def working_in_place(x):
    x /= 2.0
    return x @ (2 * GAIN.T)


class OneArray:
    """A function that writes all its actions to the same memory."""

    def __init__(self):
        self.action = np.zeros(1, np.float32)

    def __call__(self, x):
        self.action[:] = GAIN @ x
        return self.action


@pytest.mark.parametrize("function", [working_in_place, OneArray()])
def test_functions_may_write_to_their_memory(env, function):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy = load_policy(function, env)
    data = TensorDict(observation=OBSERVATION.clone(), batch_size=OBSERVATION.shape[:1])
    first = policy(data)["action"]
    assert torch.equal(data["observation"], OBSERVATION)
    torch.testing.assert_close(first, balance(OBSERVATION))
    kept = first.clone()
    actions(policy, -OBSERVATION)
    assert torch.equal(first, kept)


def test_a_batch_that_is_taken_for_one_observation_is_noticed():
    # Two entries and two actions: rows and columns can be confused, and the shape is right.
    box = Bounded(-10.0, 10.0, (2,))
    gain = torch.tensor([[1.0, 2.0], [0.0, 1.0]])
    policy = FunctionPolicy(lambda x: gain @ x, Unbounded(2), box)
    x = torch.tensor([[1.0, 2.0], [3.0, -1.0]])
    assert policy.rows
    torch.testing.assert_close(actions(policy, x), x @ gain.T)
    # A mean over the batch.
    policy = FunctionPolicy(lambda x: 0.1 * (x - x.mean()), Unbounded(2), box)
    assert policy.rows


class Integrator:
    """A controller that remembers."""

    total = 0.0

    def __call__(self, x):
        self.total += float(x.reshape(-1)[1])
        return [10 * self.total]


def test_a_function_that_remembers_or_draws_is_noticed(env):
    for function in (Integrator(), lambda x: torch.randn(*x.shape[:-1], 1)):
        with pytest.warns(UserWarning, match="a different action when called again"):
            load_policy(function, env)


def test_modules_of_another_precision(env):
    module = torch.nn.Linear(4, 1).double()
    policy = load_policy(module, env)
    found = actions(policy, OBSERVATION)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, module(OBSERVATION.double()).float().detach())


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ((["normalised"], ["action"]), r"reads \['normalised'\], which the environment does not"),
        ((["observation"], ["loc"]), r"writes \['loc'\] and no 'action'"),
    ],
)
def test_modules_of_another_environment_are_refused(env, keys, message):
    with pytest.raises(ValueError, match=message):
        load_policy(TensorDictModule(balance, *keys), env)


def recurrent_policy() -> TensorDictSequential:
    torch.manual_seed(0)
    keys = ["observation", "rs_h", "rs_c"], ["features", ("next", "rs_h"), ("next", "rs_c")]
    lstm = LSTMModule(input_size=4, hidden_size=8, in_keys=keys[0], out_keys=keys[1])
    return TensorDictSequential(
        lstm, TensorDictModule(torch.nn.Linear(8, 1), ["features"], ["action"])
    )


def test_the_memory_of_a_recurrent_policy_is_carried(env):
    policy = load_policy(recurrent_policy(), env)
    source = environment_source("InvertedPendulum-v5")
    data = source.several(2, control=policy_transforms(policy, source.one), seed=0).rollout(
        20, policy, break_when_any_done=False
    )
    first = data["is_init"].squeeze(-1)
    assert first.any() and (data["rs_h"][first] == 0).all()
    later = ~first[:, 1:]
    torch.testing.assert_close(data["rs_h"][:, 1:][later], data["next", "rs_h"][:, :-1][later])
    assert (data["rs_h"][:, 1:][later] != 0).any()
    # An environment that has all this already gets none of it again.
    own = source.single(control=policy_transforms(policy, source.one))
    assert policy_transforms(policy, lambda: own) == []


def test_modules_in_train_mode(env):
    net = torch.nn.Sequential(torch.nn.Linear(4, 4), torch.nn.BatchNorm1d(4), torch.nn.Linear(4, 1))
    for policy in (net, TensorDictModule(net, ["observation"], ["action"])):
        with pytest.raises(ValueError, match=r"layer .*1 \(BatchNorm1d\) mixes .*eval\(\)"):
            load_policy(policy, env)
    assert net[1].num_batches_tracked == 0  # nothing has been learned on the way
    load_policy(net.eval(), env)
    drops = torch.nn.Sequential(torch.nn.Dropout(0.5), torch.nn.Linear(4, 1))
    policy = TensorDictModule(drops, ["observation"], ["action"])
    with pytest.warns(UserWarning, match=r"module\.0 \(Dropout\) draws at random: call its eval"):
        load_policy(policy, env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_policy(policy.eval(), env)


def test_a_policy_with_a_controller_is_refused(env):
    actor = TensorDictModule(balance, ["observation"], ["action"])
    controller = L1Controller(lambda x, u: x * u, dt=0.04, observation_dim=4, action_dim=1)
    with pytest.raises(ValueError, match="already has an L1Controller"):
        load_policy(TensorDictSequential(actor, controller), env)
