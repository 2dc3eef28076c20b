from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv

from torchrl_l1.deployment import FunctionPolicy, load_policy, vector_environment
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.run import run

from .conftest import balance


@pytest.fixture(scope="module")
def env():
    return vector_environment(GymEnv("InvertedPendulum-v5"))


def actions(policy, observation):
    data = TensorDict(observation=observation, batch_size=observation.shape[:-1])
    return policy(data)["action"]


OBSERVATION = torch.linspace(-0.1, 0.1, 12).reshape(3, 4)


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
        (3, "int is no policy"),
        ("nothing", "unknown policy 'nothing'; policies are sb3"),
        ("math:no_such_name", "no 'no_such_name'"),
    ],
)
def test_what_is_no_policy(env, policy, message):
    with pytest.raises(ValueError, match=message):
        load_policy(policy, env)


def test_files_that_are_not_there(env):
    for kind in ("sb3", "torchscript", "onnx"):
        with pytest.raises(FileNotFoundError, match="no file missing"):
            load_policy(f"{kind}:missing", env)


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
    with pytest.raises(ValueError, match="holds more than its tensors"):
        load_policy(f"{policy_file}:network", env, weights=str(tmp_path / "module.pt"))


def test_torchrl_modules_are_taken_as_they_are(env):
    module = TensorDictModule(balance, ["observation"], ["action"])
    assert load_policy(module, env) is module


def test_torchscript(env, tmp_path):
    module = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.script(module).save(str(tmp_path / "policy.pt"))
    policy = load_policy(f"torchscript:{tmp_path / 'policy.pt'}", env)
    assert isinstance(policy, FunctionPolicy)
    torch.testing.assert_close(actions(policy, OBSERVATION), module(OBSERVATION))


def test_run_directories(env, tiny_recipe, tmp_path):
    run(tiny_recipe("outer_iterations=1"))
    policy = load_policy(str(tmp_path / "run"), env)
    (own,) = load_run(tmp_path / "run").algorithm.policies.values()
    with torch.no_grad():
        mean, _ = own.module[0].module(OBSERVATION)
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(actions(policy, OBSERVATION), mean.clamp(-3, 3))


def test_onnx(env, tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    weights = np.array([[1.0], [10.0], [1.0], [2.0]], np.float32)
    kind = onnx.TensorProto.FLOAT
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["x", "w"], ["u"])],
        "policy",
        [onnx.helper.make_tensor_value_info("x", kind, ["N", 4])],
        [onnx.helper.make_tensor_value_info("u", kind, ["N", 1])],
        [onnx.numpy_helper.from_array(weights, "w")],
    )
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=9), tmp_path / "p.onnx")
    policy = load_policy(f"onnx:{tmp_path / 'p.onnx'}", env)
    torch.testing.assert_close(actions(policy, OBSERVATION), balance(OBSERVATION))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_stable_baselines_acts_as_its_predict(env, tmp_path, name):
    sb3 = pytest.importorskip("stable_baselines3")
    model = getattr(sb3, name)("MlpPolicy", "InvertedPendulum-v5", seed=0, device="cpu")
    model.save(tmp_path / "model.zip")
    expected, _ = model.predict(OBSERVATION.numpy(), deterministic=True)
    for source in (f"sb3:{tmp_path / 'model.zip'}", model):
        found = actions(load_policy(source, env), OBSERVATION)
        torch.testing.assert_close(found, torch.as_tensor(expected))


@pytest.mark.filterwarnings("ignore")
def test_statistics_of_vecnormalize_need_a_word(env, tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    normalized = VecNormalize(make_vec_env("InvertedPendulum-v5", 1), clip_obs=2.0)
    normalized.obs_rms.mean, normalized.obs_rms.var = np.full(4, 0.02), np.full(4, 0.003)
    model = sb3.PPO("MlpPolicy", normalized, seed=0, device="cpu")
    model.save(tmp_path / "model.zip")
    normalized.save(tmp_path / "vecnormalize.pkl")
    source = f"sb3:{tmp_path / 'model.zip'}"
    with pytest.raises(ValueError, match="executes what is in it"):
        load_policy(source, env)
    raw = actions(load_policy(source, env, normalization="none"), OBSERVATION)
    torch.testing.assert_close(
        raw, torch.as_tensor(model.predict(OBSERVATION.numpy(), deterministic=True)[0])
    )
    statistics = str(tmp_path / "vecnormalize.pkl")
    found = actions(load_policy(source, env, normalization=statistics), OBSERVATION)
    scaled = normalized.normalize_obs(OBSERVATION.numpy())
    expected = torch.as_tensor(model.predict(scaled, deterministic=True)[0])
    torch.testing.assert_close(found, expected)
    assert not torch.allclose(found, raw)


def test_normalization_of_another_policy_is_refused(env):
    with pytest.raises(ValueError, match="belongs to policies of Stable-Baselines3"):
        load_policy(balance, env, normalization="statistics.pkl")
