from __future__ import annotations

import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torchrl.envs import (
    ActionScaling,
    CatTensors,
    Compose,
    DoubleToFloat,
    GymEnv,
    ObservationNorm,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import GRUModule, IndependentNormal, ProbabilisticActor, TruncatedNormal

from torchrl_l1.deployment import Exported, RobustController, export
from torchrl_l1.deployment.policies import load_policy
from torchrl_l1.envs import environment_source

# What torch says of its own exporters.
pytestmark = pytest.mark.filterwarnings("ignore")


def with_policy(robust: RobustController, policy) -> RobustController:
    acting = load_policy(policy, robust.source.one())
    return RobustController(robust.source, acting, robust.model, robust.configs)


def loaded(found: Exported) -> Callable[..., Sequence[torch.Tensor]]:
    """The function in a file, of observation and state in the order of ``found.inputs``."""
    if found.file.suffix == ".pt":
        return torch.jit.load(str(found.file))
    if found.file.suffix == ".pt2":
        return torch.export.load(str(found.file)).module()
    session = pytest.importorskip("onnxruntime").InferenceSession(str(found.file))
    assert tuple(one.name for one in session.get_outputs()) == found.outputs
    known = {one.name for one in session.get_inputs()}
    assert known <= set(found.inputs)

    def step(*values: torch.Tensor) -> list[torch.Tensor]:
        named = zip(found.inputs, values, strict=True)
        given = {name: value.numpy() for name, value in named if name in known}
        return [torch.as_tensor(one) for one in session.run(list(found.outputs), given)]

    return step


def first_action(robust: RobustController, found: Exported, x: torch.Tensor) -> torch.Tensor:
    """What a file does at the first of its steps, where L1 knows of no disturbance."""
    state = robust.wrap(robust.source.one()).reset()["l1"]
    entries = [state[name].reshape(1, -1) for name in found.inputs[1:]]
    return loaded(found)(x[None], *entries)[0][0]


@pytest.mark.parametrize(
    ("suffix", "preset", "has_policy"),
    [
        (".pt", "robust", True),
        (".pt", "paper", True),
        (".pt2", "robust", False),
        (".onnx", "robust", True),
    ],
)
def test_what_is_written_acts_as_the_transform(robust, tmp_path, suffix, preset, has_policy):
    if suffix == ".onnx":
        for name in ("onnx", "onnxscript", "onnxruntime"):
            pytest.importorskip(name)
    file = tmp_path / f"policy{suffix}"
    found = export(robust, file, preset=preset, with_policy=has_policy, steps=30)
    assert found.steps == 30 and found.error < 1e-5
    leading = ("observation",) if has_policy else ("observation", "u_rl")
    names = found.inputs[len(leading) :]
    assert found.inputs == (*leading, *names)
    step = loaded(found)
    env = robust.wrap(robust.source.single({"bias": 0.5}), preset)
    data = env.rollout(25, robust.policy)[0]
    state = [data["l1", name][:1] for name in names]
    assert not any(entry.any() for entry in state)  # it begins with zeros
    for row in data:
        given = (row["observation"], row["action"])[: len(leading)]
        action, *state = step(*(value[None] for value in given), *state)
        torch.testing.assert_close(action[0], row["next", "l1", "u_exec"], atol=1e-5, rtol=0)
    for name, entry in zip(found.outputs[1:], state, strict=True):
        expected = data["next", "l1", name.removeprefix("next_")][-1]
        torch.testing.assert_close(entry[0], expected, atol=1e-4, rtol=1e-4)


def test_as_many_steps_are_named_as_were_compared(robust, tmp_path):
    """An episode ends before, after 100 steps at the latest."""
    found = export(robust, tmp_path / "policy.pt", steps=5000)
    data = robust.wrap(robust.source.one()).rollout(5000, robust.policy)
    assert found.steps == data.shape[-1] <= 100


@pytest.mark.parametrize(
    ("suffix", "preset"), [(".pt", None), (".pt2", "paper"), (".onnx", "paper")]
)
def test_the_time_of_a_step_and_what_acts_are_told_and_written(robust, tmp_path, suffix, preset):
    if suffix == ".onnx":
        onnx = pytest.importorskip("onnx")
        pytest.importorskip("onnxscript")
        pytest.importorskip("onnxruntime")
    file = tmp_path / f"policy{suffix}"
    found = export(robust, file, preset=preset, steps=3)
    # The step is that of Gymnasium's pendulum.
    assert (found.dt, found.preset) == (0.04, preset or robust.preset)
    written = {"dt": "", "preset": ""}
    if suffix == ".pt":
        torch.jit.load(str(file), _extra_files=written)
        written = {key: value.decode() for key, value in written.items()}
    elif suffix == ".pt2":
        torch.export.load(str(file), extra_files=written)
    else:
        written = {one.key: one.value for one in onnx.load(str(file)).metadata_props}
    assert float(written["dt"]) == 0.04 and written["preset"] == found.preset


@pytest.mark.filterwarnings("default")
def test_transforms_of_the_environment_are_named(robust, tmp_path):
    def make() -> TransformedEnv:
        chain = DoubleToFloat(in_keys=["observation"]), ActionScaling(), StepCounter(100)
        norm = ObservationNorm(0.0, 1.0, in_keys=["observation"], out_keys=["scaled"])
        joined = CatTensors(["scaled"], "observation", del_keys=False)
        return TransformedEnv(GymEnv("InvertedPendulum-v5"), Compose(*chain, norm, joined))

    source = environment_source(make)
    other = RobustController(source, robust.policy, robust.model, robust.configs)
    names = ("ActionScaling", "ObservationNorm", "CatTensors(scaled)")
    with pytest.warns(UserWarning, match=r"apply ActionScaling, Obs.*scaled"):
        assert export(other, tmp_path / "policy.pt", steps=5).transforms == names
    assert export(robust, tmp_path / "policy.pt", steps=5).transforms == ()


def test_presets_that_there_are_not_are_named(robust, tmp_path):
    with pytest.raises(ValueError, match=r"preset.*'papr'"):
        export(robust, tmp_path / "policy.pt", preset="papr")


def test_what_is_not_made_of_torchs_operations_is_refused(robust, tmp_path):
    numpy = with_policy(robust, lambda x: np.tanh(np.asarray(x))[..., :1])
    with pytest.raises(ValueError, match="without-policy"):
        export(numpy, tmp_path / "policy.pt", steps=10)
    assert export(numpy, tmp_path / "l1.pt", with_policy=False, steps=10).error < 1e-5


def test_policies_with_a_memory_are_refused_for_what_they_are(robust, tmp_path):
    """Before anything is traced: neither another format nor a primer would help."""
    memory = GRUModule(4, 2, in_key="observation", out_key="hidden")
    actor = TensorDictModule(torch.nn.Linear(2, 1), ["hidden"], ["action"])
    acting = replace(robust, policy=TensorDictSequential(memory, actor))
    with pytest.raises(ValueError, match=r"remembers something .* no file can hold: export L1 al"):
        export(acting, tmp_path / "policy.pt", steps=10)


def decides(x):
    """One action along an undisturbed episode, and another where that does not lead."""
    return -torch.ones_like(x[..., :1]) if (x[..., 1] > 0.5).any() else x[..., 1:2]


def decides_in_numpy(x):
    x = np.asarray(x)
    return np.where(x[..., 1:2] > 0.5, -1.0, 1.0).astype(np.float32)


class Decides(torch.nn.Module):
    """The same as a module, for a script."""

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if bool((x[..., 1] > 0.5).any()):
            return -torch.ones_like(x[..., :1])
        return self.gain * x[..., 1:2]


@pytest.mark.parametrize("policy", [decides, decides_in_numpy])
@pytest.mark.parametrize("suffix", [".pt", ".pt2"])
def test_policies_that_decide_in_python_are_refused(robust, tmp_path, policy, suffix, capfd):
    with pytest.raises(ValueError, match="without-policy") as error:
        export(with_policy(robust, policy), tmp_path / f"policy{suffix}", steps=3)
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())
    assert "forward" not in "".join(capfd.readouterr()), "programs of torch's"


def test_what_is_no_number_away_from_the_recorded_steps_is_no_agreement(
    robust, tmp_path, monkeypatch
):
    def writer(module, example, file, *_):
        def step(observation, *state):
            action, *following = module(observation, *state)
            return torch.where(observation.abs().max() > 1, torch.nan, action), *following

        file.touch()
        return step

    monkeypatch.setitem(sys.modules["torchrl_l1.deployment.export"]._WRITERS, "export", writer)
    with pytest.raises(ValueError, match="differs by up to inf action units"):
        export(robust, tmp_path / "policy.pt2", steps=3)


def test_decisions_in_torch_are_written(robust, tmp_path):
    bang = with_policy(robust, lambda x: torch.where(x[..., 1:2] > 0.5, -1.0, 1.0))
    found = export(bang, tmp_path / "policy.pt", steps=3)
    for angle, expected in ((0.0, 1.0), (1.0, -1.0)):
        action = first_action(robust, found, torch.tensor([0.0, angle, 0.0, 0.0]))
        assert action.item() == pytest.approx(expected, abs=1e-5)


def test_scripts_and_checks_of_distributions_are_written(robust, tmp_path):
    """What decides in a script is in it whole; TorchRL's checks of arguments are no decision."""
    torch.jit.save(torch.jit.script(Decides()), str(tmp_path / "script.pt"))
    network = torch.nn.Sequential(torch.nn.Linear(4, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]), ["loc", "scale"], ["action"],
        distribution_class=TruncatedNormal, distribution_kwargs={"low": -3.0, "high": 3.0},
    )  # fmt: skip
    for policy in (f"torchscript:{tmp_path / 'script.pt'}", actor):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            acting = with_policy(robust, policy)
            found = export(acting, tmp_path / "policy.pt", steps=3)
        assert found.error < 1e-5
        for angle in (0.1, 0.7):
            x = torch.tensor([0.0, angle, 0.0, 0.0])
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                expected = acting.policy(TensorDict(observation=x))["action"]
            torch.testing.assert_close(first_action(robust, found, x), expected)


@pytest.mark.parametrize("suffix", [".pt2", ".onnx"])
def test_scripts_go_to_torchscript_only(robust, tmp_path, suffix):
    if suffix == ".onnx":
        for name in ("onnx", "onnxscript", "onnxruntime"):
            pytest.importorskip(name)
    torch.jit.save(torch.jit.script(Decides()), str(tmp_path / "script.pt"))
    acting = with_policy(robust, f"torchscript:{tmp_path / 'script.pt'}")
    with pytest.raises(ValueError, match=r"cannot be written as .*: try \.pt, or export L1 alone"):
        export(acting, tmp_path / f"policy{suffix}", steps=3)


def test_what_cannot_be_copied_is_refused_in_a_line(robust, tmp_path):
    """As a session of a network, or of ONNX."""
    policy = torch.nn.Linear(4, 1)
    policy.lock = threading.Lock()
    with pytest.raises(ValueError, match=r"torchscript \(cannot pickle .*\): export L1 alone"):
        export(with_policy(robust, policy), tmp_path / "policy.pt", steps=3)


class Checks(torch.nn.Module):
    """Decides by what it holds itself, and refuses what is no observation."""

    def __init__(self):
        super().__init__()
        self.register_buffer("count", torch.tensor(3.0))
        self.linear = torch.nn.Linear(4, 1)

    def forward(self, x):
        assert x.isfinite().all(), "not finite"
        if (x.abs() > 1).any():
            raise ValueError("out of range")
        return self.linear(x / 2 if self.count > 1 else x)


def test_checks_and_decisions_by_what_a_policy_holds_are_told_of(robust, tmp_path):
    with pytest.warns(UserWarning, match="reads values in Python .*test_export.py, line"):
        found = export(with_policy(robust, Checks()), tmp_path / "policy.pt", steps=3)
    assert found.error < 1e-5


def test_the_place_is_looked_at_before_work(robust, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    (tmp_path / "folder.pt").mkdir()
    monkeypatch.setattr(sys.modules["torchrl_l1.deployment.export"], "run_episodes", None)
    for place in ("file/policy.pt", "folder.pt"):
        with pytest.raises(OSError, match=place.partition(".")[0].split("/")[0]):
            export(robust, tmp_path / place, steps=3)


def test_files_of_the_policy_are_not_replaced(robust, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.jit.save(torch.jit.script(torch.nn.Linear(4, 1)), "policy.pt")
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    for name in ("run/checkpoint.pt", "run/checkpoints/best.pt", "before.pt"):
        (tmp_path / name).touch()
    given = replace(robust, origin={"policy": "torchscript:policy.pt"})
    saved = RobustController.load(given.save("controller"))
    run = replace(robust, origin={"policy": "run"})
    kept = replace(robust, origin={"policy": "run/checkpoints/best.pt"})
    weights = replace(robust, origin={"policy": "own.py:network", "weights": "policy.pt"})
    for one, name in (
        (given, "policy.pt"), (saved, tmp_path / "policy.pt"), (saved, "controller/policy.pt"),
        (run, "run/checkpoint.pt"), (kept, "run/checkpoint.pt"), (weights, "policy.pt"),
    ):  # fmt: skip
        before = (tmp_path / name).read_bytes()
        with pytest.raises(ValueError, match=r"the policy comes from .*: name another file"):
            export(one, name, steps=3)
        assert (tmp_path / name).read_bytes() == before
    for name in ("before.pt", "run/robust.pt"):
        assert export(run, name, steps=3).file.stat().st_size > 0


def test_other_suffixes_are_refused(robust, tmp_path):
    with pytest.raises(
        ValueError, match=r"policy.json must end in .pt, .ts, .onnx, .pt2; otherwise give a form"
    ):
        export(robust, tmp_path / "policy.json")


def test_sampling_policies_export_their_mean(robust, tmp_path):
    network = torch.nn.Sequential(torch.nn.Linear(4, 2), torch.nn.Tanh())
    module = TensorDictModule(
        torch.nn.Sequential(network, NormalParamExtractor()), ["observation"], ["loc", "scale"]
    )
    actor = ProbabilisticActor(
        module, ["loc", "scale"], ["action"], distribution_class=IndependentNormal,
    )  # fmt: skip
    found = export(with_policy(robust, actor), tmp_path / "policy.pt", steps=10)
    assert found.error < 1e-5
    x = torch.tensor([0.0, 0.1, 0.2, -0.3])
    mean = actor.get_dist(TensorDict(observation=x)).mean
    torch.testing.assert_close(first_action(robust, found, x), mean)
