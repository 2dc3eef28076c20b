from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from torchrl_l1.deployment import FunctionPolicy, RobustController, load_policy
from torchrl_l1.deployment.policy_files import FILE_KINDS, FileKind

from .conftest import GAIN, OBSERVATION, actions, balance

BOX = spaces.Box(-1.0, 1.0, (2,))


def test_files_that_are_not_there(env):
    for kind in FILE_KINDS:
        with pytest.raises(FileNotFoundError, match="no file missing"):
            load_policy(f"{kind}:missing", env)


def test_torchscript(env, tmp_path):
    module = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.script(module).save(str(tmp_path / "policy.pt"))
    policy = load_policy(f"torchscript:{tmp_path / 'policy.pt'}", env)
    assert isinstance(policy, FunctionPolicy)
    torch.testing.assert_close(actions(policy, OBSERVATION), module(OBSERVATION))


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
    with pytest.raises(ValueError, match="executes its contents"):
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


@pytest.mark.parametrize(
    "statistics",
    [
        "vecnormalize.pkl",
        "vec_normalize.pkl",
        "VecNormalize-best.pkl",
        "rl_model_vecnormalize_64_steps.pkl",
        "rl_model_64_steps/vecnormalize.pkl",
    ],
)
def test_statistics_are_found_by_all_their_usual_names(env, tmp_path, monkeypatch, statistics):
    """Of Stable-Baselines3's callback, its Zoo and the hub; nothing is read before."""
    monkeypatch.setitem(sys.modules, "stable_baselines3", SimpleNamespace())
    model = tmp_path / "rl_model_64_steps.zip"
    model.touch()
    (tmp_path / "replay_buffer.pkl").touch()
    with pytest.raises(ValueError, match="cannot be read as sb3"):
        load_policy(f"sb3:{model}", env)
    (tmp_path / statistics).parent.mkdir(exist_ok=True)
    (tmp_path / statistics).touch()
    with pytest.raises(ValueError, match=rf"{statistics} lies beside .*, or say 'none'"):
        load_policy(f"sb3:{model}", env)


def test_of_several_statistics_those_of_the_model_s_steps_are_named(env, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", SimpleNamespace())
    for steps in (8, 64, 128):
        (tmp_path / f"rl_model_{steps}_steps.zip").touch()
        (tmp_path / f"rl_model_vecnormalize_{steps}_steps.pkl").touch()
    with pytest.raises(ValueError, match=r"vecnormalize_64_steps\.pkl lies beside"):
        load_policy(f"sb3:{tmp_path / 'rl_model_64_steps.zip'}", env)


@pytest.mark.parametrize(
    ("observation", "action", "message"),
    [
        (spaces.Dict({"goal": BOX}), BOX, r"the policy reads Dict\('goal': Box"),
        (BOX, spaces.Discrete(2), r"the policy acts in Discrete\(2\): it must"),
        (spaces.Box(0, 255, (8, 8, 3)), BOX, "Box of one dimension"),
    ],
)
def test_models_of_other_spaces_are_refused(env, observation, action, message):
    policy = SimpleNamespace(
        squash_output=False, observation_space=observation, action_space=action
    )
    with pytest.raises(ValueError, match=message):
        load_policy(SimpleNamespace(policy=policy, predict=len), env)


@pytest.mark.filterwarnings("ignore")
def test_a_model_of_stable_baselines_brings_its_normaliser(env):
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    normalized = VecNormalize(make_vec_env("InvertedPendulum-v5", 1), clip_obs=2.0)
    normalized.obs_rms.mean, normalized.obs_rms.var = np.full(4, 0.02), np.full(4, 0.003)
    model = sb3.PPO("MlpPolicy", normalized, seed=0, device="cpu")
    scaled = normalized.normalize_obs(OBSERVATION.numpy())
    expected = torch.as_tensor(model.predict(scaled, deterministic=True)[0])
    torch.testing.assert_close(actions(load_policy(model, env), OBSERVATION), expected)


def test_an_entry_of_the_table_is_all_that_a_kind_needs(env, robust, tmp_path, monkeypatch):
    file = tmp_path / "gains.txt"
    np.savetxt(file, GAIN)
    kind = FileKind(lambda file, _: lambda x: [float(x @ np.loadtxt(file))], is_code=False)
    monkeypatch.setitem(FILE_KINDS, "gains", kind)
    origin = {"policy": f"gains:{file}"}
    policy = load_policy(origin["policy"], env)
    torch.testing.assert_close(actions(policy, OBSERVATION), balance(OBSERVATION))
    folder = replace(robust, policy=policy, origin=origin).save(tmp_path / "controller")
    file.unlink()
    loaded = RobustController.load(folder, trusted=False).policy
    torch.testing.assert_close(actions(loaded, OBSERVATION), balance(OBSERVATION))
    monkeypatch.setitem(FILE_KINDS, "gains", kind._replace(is_code=True))
    with pytest.raises(ValueError, match=r"names 'gains:policy_gains\.txt', which would be run"):
        RobustController.load(folder, trusted=False)
