from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import GymWrapper

from torchrl_l1.control import L1Config
from torchrl_l1.deployment import (
    RobustController,
    environment_source,
    load_target,
    robust_controller,
    robustify,
)
from torchrl_l1.deployment.robust_controller import source_for
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig
from torchrl_l1.envs import make_env
from torchrl_l1.experiment.run import run

from .conftest import balance

TINY = {"environments": 2, "progress": False, "model": {"hidden": [4], "members": 1}}
QUICK = FitConfig(max_epochs=1, batch_size=50)


def test_what_is_saved_acts_the_same(robust, policy_file, tmp_path):
    saved = replace(robust, origin={"policy": f"{policy_file}:balance"})
    folder = saved.save(tmp_path / "controller")
    assert not [file for file in folder.iterdir() if file.suffix in (".pt", ".pkl")]
    loaded = RobustController.load(folder)
    first, second = (
        one.wrap(make_env("inverted_pendulum", 2, bias=0.5, seed=0)).rollout(20, one.policy)
        for one in (robust, loaded)
    )
    assert torch.equal(first["next", "l1", "u_exec"], second["next", "l1", "u_exec"])
    assert loaded.configs == robust.configs and loaded.preset == robust.preset
    assert load_target(str(tmp_path), trusted=True).configs == robust.configs
    with pytest.raises(ValueError, match=r"give --trust \(trusted=True in Python\) if"):
        load_target(str(tmp_path))


def test_files_of_two_saves_are_no_controller(robust, tmp_path, monkeypatch):
    folder = robust.save(tmp_path)
    other = copy.deepcopy(robust.model)
    for parameter in other.parameters():
        parameter.data.mul_(2)
    second = replace(robust, model=other)
    with monkeypatch.context() as broken_off:
        broken_off.setattr(robust_controller, "write_atomically", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            second.save(folder)
    with pytest.raises(
        ValueError, match=r"model\.safetensors is not the one that controller\.json"
    ):
        RobustController.load(folder, policy=balance)
    second.save(folder)
    assert RobustController.load(folder, policy=balance).preset == "robust"


@pytest.mark.filterwarnings("ignore:the model is too poor")
def test_code_that_has_changed_since_is_told(policy_file, tmp_path):
    name = f"{policy_file}:balance"
    made = robustify("inverted_pendulum", name, 60, fit=QUICK, **TINY)
    before = policy_file.read_text()
    policy_file.write_text(before.replace("1.0, 10.0", "-1.0, -10.0"))
    folder = made.save(tmp_path / "controller")
    with pytest.warns(UserWarning, match=r"own_policy\.py changed since the controller"):
        changed = RobustController.load(folder)
    changed.save(folder)
    assert RobustController.load(folder).preset == "robust"


def test_files_of_one_name_do_not_overwrite_each_other(robust, tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "model.safetensors").write_text(folder)
    origin = {
        "policy": f"onnx:{tmp_path / 'a' / 'model.safetensors'}",
        "weights": str(tmp_path / "b" / "model.safetensors"),
    }
    saved = replace(robust, origin=origin).save(tmp_path / "controller")
    assert (saved / "policy_model.safetensors").read_text() == "a"
    assert (saved / "weights_model.safetensors").read_text() == "b"


def test_files_of_policies_go_into_the_folder(robust, tmp_path):
    file = tmp_path / "policy.pt"
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.script(torch.nn.Linear(4, 1)).save(str(file))
    saved = replace(robust, origin={"policy": f"torchscript:{file}"})
    folder = saved.save(tmp_path / "controller")
    expected = file.read_bytes()
    file.unlink()
    loaded = RobustController.load(folder)
    assert (folder / "policy.pt").read_bytes() == expected
    moved = tmp_path / "elsewhere"
    loaded.save(moved)
    assert RobustController.load(moved).policy.rows is False


def test_a_model_of_several_files_goes_into_the_folder_whole(robust, tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    gain = onnx.numpy_helper.from_array(np.array([[1.0], [10.0], [1.0], [2.0]], np.float32), "gain")
    make, kind = onnx.helper, onnx.TensorProto.FLOAT
    x, u = (make.make_tensor_value_info(name, kind, ["N", n]) for name, n in (("x", 4), ("u", 1)))
    graph = make.make_graph([make.make_node("MatMul", ["x", "gain"], ["u"])], "g", [x], [u], [gain])
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8)
    file = tmp_path / "policy.onnx"
    onnx.save_model(
        model, str(file), save_as_external_data=True, location="weights.bin", size_threshold=0
    )
    folder = replace(robust, origin={"policy": f"onnx:{file}"}).save(tmp_path / "controller")
    for name in ("policy.onnx", "weights.bin"):
        (tmp_path / name).unlink()
    observation = torch.full((2, 4), 0.1)
    action = RobustController.load(folder).policy(TensorDict(observation=observation))["action"]
    torch.testing.assert_close(action, balance(observation))


def test_what_is_named_is_found_from_any_folder(robust, policy_file, tmp_path, monkeypatch):
    """Another file of that name, where the controller is used, is another policy."""
    monkeypatch.chdir(tmp_path)
    source = environment_source("own_policy.py:make_env")
    own = replace(robust, source=source, origin={"policy": "own_policy.py:balance"})
    own.save("controller")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    text = policy_file.read_text()
    Path("own_policy.py").write_text(text.replace("1.0, 10.0", "-9.0, 0.0"))
    loaded = RobustController.load("../controller")
    data = TensorDict(observation=torch.randn(5, 4), batch_size=[5])
    expected = balance(data["observation"]).clamp(-3.0, 3.0)
    torch.testing.assert_close(loaded.policy(data)["action"], expected)
    assert loaded.source.name == "own_policy.py:make_env"
    # What is named anew is that of here, and the controller's from then on.
    other = RobustController.load("../controller", policy="own_policy.py:balance")
    there = data["observation"] @ torch.tensor([-9.0, 0.0, 1.0, 2.0])
    torch.testing.assert_close(other.policy(data)["action"][:, 0], there.clamp(-3.0, 3.0))
    stored = json.loads((other.save("other") / "controller.json").read_text())
    assert stored["given"] == f"{Path('own_policy.py').resolve()}:balance"
    kept = RobustController.load("other").policy(data)["action"]
    torch.testing.assert_close(kept[:, 0], there.clamp(-3.0, 3.0))
    # And from there once more.
    loaded.save("again")
    Path("own_policy.py").unlink()
    assert RobustController.load("again").preset == "robust"


def test_objects_are_asked_for_again(robust, tmp_path):
    folder = robust.save(tmp_path)
    with pytest.raises(ValueError, match="does not name the policy, which was an object"):
        RobustController.load(folder)
    assert RobustController.load(folder, policy=balance).configs == robust.configs
    stored = json.loads((folder / "controller.json").read_text())
    (folder / "controller.json").write_text(json.dumps({**stored, "format": 99}))
    with pytest.raises(ValueError, match="has the format 99"):
        RobustController.load(folder)
    with pytest.raises(FileNotFoundError, match="holds no controller"):
        RobustController.load(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("l1", "preset"), [("paper", "paper"), ("off", "robust"), ("reference", "robust")]
)
def test_runs_bring_their_own_model_and_settings(l1, preset, tiny_recipe, tmp_path):
    run(tiny_recipe("outer_iterations=1", f"l1={l1}", "l1.epsilon=0.7"))
    robust = load_target(str(tmp_path / "run"))
    assert robust.settings("paper").epsilon == 0.7
    assert robust.preset == preset and robust.source.name == "inverted_pendulum"
    env = robust.wrap(robust.source.single())
    assert env.rollout(3, robust.policy).shape == (1, 3)


def test_a_runs_policy_sees_the_parts_of_the_observation_in_its_own_order(tmp_path):
    (tmp_path / "envs.py").write_text(
        "import gymnasium\nfrom gymnasium.spaces import Box, Dict\n\n\n"
        "class Parts(gymnasium.Env):\n"
        "    action_space = Box(-1, 1, (1,))\n"
        "    observation_space = Dict(place=Box(-9, 9, (1,)), speed=Box(-9, 9, (1,)))\n\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        return {name: part.low for name, part in self.observation_space.items()}, {}\n"
    )
    name = "envs.py:Parts"
    (tmp_path / "config.yaml").write_text(
        f"task: {name}\nsearch_path: ['{tmp_path}']\nobservation_keys: [speed, place]\n"
    )
    assert source_for(name, str(tmp_path)).observation_keys == ("speed", "place")
    assert source_for("gymnasium/Pendulum-v1", str(tmp_path)).observation_keys == ()


def test_a_wrapped_environment_has_the_parts_in_that_order_too():
    class Parts(gymnasium.Env):
        action_space = Box(-1, 1, (1,))
        observation_space = Dict(place=Box(-9, 9, (1,)), speed=Box(-9, 9, (1,)))

        def reset(self, *, seed=None, options=None):
            return {"place": np.ones(1, np.float32), "speed": 2 * np.ones(1, np.float32)}, {}

    source = replace(environment_source(Parts), observation_keys=("speed", "place"))
    policy = TensorDictModule(lambda x: x[..., :1], ["observation"], ["action"])
    configs = {"robust": L1Config.robust(0.05)}
    robust = RobustController(source, policy, EnsembleDynamics(2, 1, hidden=(4,)), configs)
    for env in (GymWrapper(Parts()), source.one()):
        assert robust.wrap(env).reset()["observation"].tolist() == [2.0, 1.0]
    with pytest.raises(TypeError, match=r"Parts is an environment of Gymnasium: .*GymWrapper"):
        robust.wrap(Parts())


def test_targets_that_are_none(tmp_path):
    with pytest.raises(ValueError, match="there is no folder"):
        load_target("gymnasium/Pendulum-v1")


@pytest.mark.parametrize("name", ["policy", "normalization", "weights"])
def test_what_a_target_has_of_its_own_is_not_given_beside_it(name, tmp_path):
    kept = tmp_path / "checkpoints" / "best.pt"
    kept.parent.mkdir()
    kept.touch()
    for target in (tmp_path, kept):
        with pytest.raises(ValueError, match=f"has its own policy: leave --{name} out"):
            load_target(str(target), **{name: "none"})


def test_code_that_a_run_names_is_not_run_without_trust(robust, tiny_recipe, tmp_path):
    code = "def reward(x, u, y):\n    return x[..., 0]\n"
    (tmp_path / "mine.py").write_text(code)
    folder = run(
        tiny_recipe(
            "outer_iterations=1", "checkpoint.every=1",
            "reward=mine.py:reward", f"search_path=[{tmp_path}]",
        )
    )  # fmt: skip
    (tmp_path / "mine.py").write_text(f"import os\nos.mkdir({str(tmp_path / 'ran')!r})\n{code}")
    kept = folder / "checkpoints" / "after_1.pt"
    named = replace(robust, origin={"policy": str(folder)}).save(tmp_path / "controller")
    beside = replace(robust, origin={"policy": "checkpoints/after_1.pt"}).save(tmp_path / "beside")
    for target in (folder, kept, named):
        with pytest.raises(ValueError, match=r"names 'mine\.py:reward', which would be run"):
            load_target(str(target))
    with pytest.raises(ValueError, match=r"names 'mine\.py:reward', which would be run"):
        load_target("inverted_pendulum", policy=str(folder))
    for file in beside.iterdir():
        file.rename(folder / file.name)
    with pytest.raises(ValueError, match=r"names 'mine\.py:reward', which would be run"):
        load_target(str(folder))
    assert not (tmp_path / "ran").exists()
    load_target(str(kept), trusted=True)
    assert (tmp_path / "ran").exists()
