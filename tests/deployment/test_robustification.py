from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase, GymEnv, TransformedEnv

import torchrl_l1
from torchrl_l1.control import L1Transform
from torchrl_l1.deployment import robustification, robustify
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.envs import ActuatorBias, make_env

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


@pytest.mark.filterwarnings("ignore:the model is too poor")
@pytest.mark.parametrize(("given", "expected"), [(None, 50.0), (7.0, 7.0)])
def test_the_papers_tolerance_is_that_of_a_rate_of_switches(given, expected, monkeypatch):
    asked = []

    def found(model, data, rate):
        asked.append((data.numel(), rate))
        return 0.125, rate

    monkeypatch.setattr(robustification, "epsilon_for", found)
    made = robustify("inverted_pendulum", balance, 60, switch_rate=given, fit=QUICK, **TINY)
    assert made.settings("paper").epsilon == 0.125
    assert asked == [(60, expected)]


def test_data_of_another_environment_are_refused():
    data = GymEnv("Pendulum-v1").rollout(50)
    with pytest.raises(ValueError, match=r"an observation of width 3, but the .* width 4"):
        robustify("inverted_pendulum", balance, data=data, progress=False)


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


@pytest.mark.filterwarnings("ignore:the model is too poor")
def test_a_disturbance_in_the_data_is_noticed():
    def make() -> EnvBase:
        return TransformedEnv(GymEnv("InvertedPendulum-v5"), ActuatorBias(0.5))

    with pytest.warns(UserWarning, match="already has ActuatorBias"):
        robustify(make, balance, 60, fit=QUICK, **TINY)


def test_an_environment_with_a_controller_is_refused(robust):
    def make() -> EnvBase:
        return robust.wrap(GymEnv("InvertedPendulum-v5"))

    with pytest.raises(ValueError, match="already has L1Transform"):
        robustify(make, balance, 60, fit=QUICK, **TINY)
