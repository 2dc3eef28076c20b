from __future__ import annotations

import json
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase, GymEnv, GymWrapper, TransformedEnv

import torchrl_l1
from torchrl_l1.control import L1Config, L1Transform
from torchrl_l1.deployment import RobustController, environment_source, load_target, robustify
from torchrl_l1.deployment.robust_controller import _source
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig
from torchrl_l1.envs import ActuatorBias, make_env
from torchrl_l1.experiment.run import run

from .conftest import balance

TINY = {"environments": 2, "progress": False, "model": {"hidden": [4], "members": 1}}
QUICK = FitConfig(max_epochs=1, batch_size=50)


def test_one_call_from_a_policy_to_a_robust_one(robust):
    assert torchrl_l1.robustify is robustify
    assert robust.config.dt == 0.04 and robust.config.filter == "kalman"
    assert robust.settings("paper").filter == "low_pass"
    assert robust.config.half_range == 3.0
    assert min(robust.model.quality.explained) > 0.8
    # The filter's numbers are those of the data, not those of a model that knows none.
    assert robust.model.residuals.measured
    assert robust.model.residuals.calibrated
    env = robust.wrap(make_env("inverted_pendulum", 3, bias=0.5, seed=0))
    assert isinstance(env.transform[-1], L1Transform)
    data = env.rollout(60, robust.policy)
    sent = data["next", "l1", "u_exec"] - data["action"]
    # It finds the bias of 0.5, which nothing told it.
    torch.testing.assert_close(sent[:, 40:].mean(), torch.tensor(-0.5), atol=0.1, rtol=0)


@pytest.mark.filterwarnings("ignore:the model is too poor")
@pytest.mark.parametrize(
    "env", ["inverted_pendulum", lambda: make_env("inverted_pendulum", 2)], ids=["name", "function"]
)
def test_the_generator_of_the_caller_is_left_alone(env):
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    made = [robustify(env, balance, 60, fit=QUICK, **TINY) for _ in range(2)]
    assert torch.equal(torch.random.get_rng_state(), before)
    for one, other in zip(*(made[i].model.parameters() for i in (0, 1)), strict=True):
        assert torch.equal(one, other)
    assert made[0].configs == made[1].configs


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
    with pytest.raises(ValueError, match="say --trust"):
        load_target(str(tmp_path))


@pytest.mark.filterwarnings("ignore:the model is too poor")
@pytest.mark.parametrize("form", ["rows", "buffer", "list"])
def test_recorded_data_take_the_place_of_collected_ones(form):
    torch.manual_seed(0)

    def explore(x: torch.Tensor) -> torch.Tensor:
        return balance(x.float()) + torch.randn(*x.shape[:-1], 1)

    policy = TensorDictModule(explore, ["observation"], ["action"])
    # Of float64, and with the resets of episodes that end.
    data = TransformedEnv(GymEnv("InvertedPendulum-v5")).rollout(
        300, policy, break_when_any_done=False
    )
    data["observation"][7] = torch.nan
    given = {"rows": data, "list": [data[:150], data[150:]]}.get(form)
    if form == "buffer":
        given = ReplayBuffer(storage=LazyTensorStorage(300))
        given.extend(data)
    with pytest.warns(UserWarning, match="not finite"):
        made = robustify("InvertedPendulum-v5", balance, data=given, fit=QUICK, **TINY, steps=10**9)
    quality = made.model.quality
    assert quality.training + quality.validation == 299
    assert made.settings("paper").epsilon > 0
    assert made.model.residuals.calibrated


def test_data_of_another_environment_are_refused():
    data = GymEnv("Pendulum-v1").rollout(50)
    with pytest.raises(ValueError, match=r"an observation of width 3, and the .* one of 4"):
        robustify("inverted_pendulum", balance, data=data, progress=False)


@pytest.mark.parametrize("content", ["[]", "3", "{}", '{"format": 1}', "{", '{"format": 7}', ""])
def test_a_damaged_controller_is_named(content, tmp_path):
    (tmp_path / "controller.json").write_text(content)
    with pytest.raises(ValueError, match=r"controller\.json (is damaged|has the format)"):
        RobustController.load(tmp_path)


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


def test_objects_are_asked_for_again(robust, tmp_path):
    folder = robust.save(tmp_path)
    with pytest.raises(ValueError, match="names no policy, which was an object"):
        RobustController.load(folder)
    assert RobustController.load(folder, policy=balance).configs == robust.configs
    stored = json.loads((folder / "controller.json").read_text())
    (folder / "controller.json").write_text(json.dumps({**stored, "format": 99}))
    with pytest.raises(ValueError, match="has the format 99"):
        RobustController.load(folder)
    with pytest.raises(FileNotFoundError, match="holds no controller"):
        RobustController.load(tmp_path / "nothing")


def test_a_time_step_that_nobody_tells_must_be_given():
    with pytest.raises(ValueError, match="give dt"):
        robustify("MountainCarContinuous-v0", lambda x: x[..., :1], 10, progress=False)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "best"}, "preset"),
        ({"steps": 0}, "steps must be at least 1"),
        ({"noise": -1.0}, "noise must be"),
        ({"dt": 0.0}, "dt must be"),
    ],
)
def test_settings_that_make_no_sense(settings, message):
    with pytest.raises(ValueError, match=message):
        robustify("inverted_pendulum", balance, **settings)


def test_a_poor_model_is_noticed():
    class Noise(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return torch.zeros_like(x[..., :1])

    def make() -> EnvBase:
        from torchrl_l1.envs import ObservationNoise

        return TransformedEnv(GymEnv("InvertedPendulum-v5"), ObservationNoise(2.0))

    with pytest.warns(UserWarning, match="too poor for L1"):
        robustify(make, Noise(), 200, dt=0.04, fit=QUICK, **{**TINY, "model": {"hidden": [4]}})


def test_runs_bring_their_own_model_and_settings(tiny_recipe, tmp_path):
    run(tiny_recipe("outer_iterations=1", "l1=paper", "l1.epsilon=0.7"))
    robust = load_target(str(tmp_path / "run"))
    assert robust.settings("paper").epsilon == 0.7
    assert robust.config.filter == "kalman" and robust.source.name == "inverted_pendulum"
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
    assert _source(name, str(tmp_path)).observation_keys == ("speed", "place")
    assert _source("gymnasium/Pendulum-v1", str(tmp_path)).observation_keys == ()


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
    with pytest.raises(ValueError, match="leave --policy out"):
        load_target(str(tmp_path), policy="sb3:x.zip")


@pytest.mark.filterwarnings("ignore:the model is too poor")
def test_a_disturbance_in_the_data_is_noticed():
    def make() -> EnvBase:
        return TransformedEnv(GymEnv("InvertedPendulum-v5"), ActuatorBias(0.5))

    with pytest.warns(UserWarning, match="brings ActuatorBias along"):
        robustify(make, balance, 60, fit=QUICK, **TINY)


def test_an_environment_with_a_controller_is_refused(robust):
    def make() -> EnvBase:
        return robust.wrap(GymEnv("InvertedPendulum-v5"))

    with pytest.raises(ValueError, match="brings L1Transform along"):
        robustify(make, balance, 60, fit=QUICK, **TINY)
