from __future__ import annotations

import pickle
import random
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from torchrl_l1.dynamics import (
    ControlAffineDynamics,
    DeterministicHead,
    EnsembleDynamics,
    GaussianHead,
    fit_dynamics,
    make_dynamics,
)


@pytest.fixture(scope="module")
def data() -> TensorDict:
    torch.manual_seed(0)
    x, u = torch.randn(300, 3) * torch.tensor([1.0, 10.0, 0.1]), torch.randn(300, 2)
    made = TensorDict({"observation": x, "action": u}, batch_size=[300])
    made["next", "observation"] = 0.9 * x + 0.3 * u.sum(-1, keepdim=True)
    return made


@pytest.mark.filterwarnings("ignore:the model is too poor for L1")
@pytest.mark.parametrize("form", ["nonlinear", "affine"])
@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
def test_what_is_loaded_predicts_the_same_to_the_last_bit(
    form: str, head: str, data: TensorDict, tmp_path: Path
) -> None:
    model = fit_dynamics(
        data,
        form=form,
        head=head,
        members=4,
        hidden=(9, 7),
        activation="tanh",
        elites=2,
        box_margin=0.25,
        std_floor=1e-3,
        max_epochs=2,
        names=["a", "b", "c"],
        units=["m", "", "rad"],
    )
    model.save(tmp_path / "model.safetensors")
    state = torch.get_rng_state()
    loaded = EnsembleDynamics.load(tmp_path / "model.safetensors")
    assert torch.equal(torch.get_rng_state(), state)
    assert type(loaded) is type(model) and not loaded.training
    assert str(loaded.head) == str(model.head)
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    x, u = data["observation"], data["action"]
    for one, other in zip(
        model.value_and_jacobian(x, u), loaded.value_and_jacobian(x, u), strict=True
    ):
        assert torch.equal(one, other)
    for source in ("residuals", "heads", "sum"):
        one, other = (m.residual_covariance(x[:5], u[:5], source) for m in (model, loaded))
        assert torch.equal(one, other)
    assert loaded.elites.tolist() == model.elites.tolist() and len(loaded.elites) == 2
    assert bool(loaded.residuals.measured)
    # Not by ==: no trajectory has 50 steps, and nan is not nan.
    assert repr(loaded.quality) == repr(model.quality)
    fitted = fit_dynamics(data, form=form, head=head, members=4, max_epochs=1, hidden=(9, 7))
    fitted.load_state_dict(loaded.state_dict())


def test_settings_of_head_box_and_precision_come_back(tmp_path: Path) -> None:
    head = GaussianHead(2, min_log_variance=-4, max_log_variance=1, bound_penalty=0.02)
    model = EnsembleDynamics(2, 1, 2, (), "silu", 0.5, 0.75, head).double()
    model.save(tmp_path / "model")
    loaded = EnsembleDynamics.load(str(tmp_path / "model"))
    assert isinstance(loaded.head, GaussianHead) and loaded.head.bound_penalty == 0.02
    assert loaded.network.activation == "silu" and len(loaded.network.weights) == 1
    assert (loaded.box.margin, loaded.action_normalizer.std_floor) == (0.75, 0.5)
    assert loaded.change_normalizer.mean.dtype is torch.float64 and loaded.quality is None
    with pytest.raises(ValueError, match="holds a EnsembleDynamics, not a ControlAffineDynamics"):
        ControlAffineDynamics.load(tmp_path / "model")


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    for members in (2, 3):
        EnsembleDynamics(2, 1, members, (4,)).save(tmp_path / "model")
    assert EnsembleDynamics.load(tmp_path / "model").members == 3
    assert [file.name for file in tmp_path.iterdir()] == ["model"]


class Own(EnsembleDynamics):
    pass


class OwnHead(DeterministicHead):
    pass


def test_what_cannot_be_restored_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"cannot save a Own: .* torch.save with its state_dict"):
        Own(2, 1, 2, (4,)).save(tmp_path / "model")
    with pytest.raises(TypeError, match="cannot save a model with the head OwnHead"):
        EnsembleDynamics(2, 1, 2, (4,), head=OwnHead()).save(tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_damage_is_noticed_wherever_it_is(tmp_path: Path) -> None:
    file = tmp_path / "model"
    make_dynamics(2, 1, hidden=(4,), members=2, head="gaussian").save(file)
    whole = file.read_bytes()
    places = random.Random(0)
    changed = [whole[: len(whole) * part // 8] for part in range(8)] + [whole + b"\0"]
    for place in [*range(0, len(whole), 37), *places.sample(range(len(whole)), 50)]:
        changed.append(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
    for damaged in changed:
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"model (is damaged|holds|has version)") as caught:
            EnsembleDynamics.load(file)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["tensors", "torch", "pickle", "text", "folder", "nothing"])
def test_other_files_are_told(kind: str, tmp_path: Path) -> None:
    file = tmp_path / "model"
    if kind == "tensors":
        save_file({"weight": torch.zeros(3)}, file)
    elif kind == "torch":
        torch.save(EnsembleDynamics(2, 1, 2, (4,)).state_dict(), file)
    elif kind == "pickle":
        file.write_bytes(pickle.dumps({"weight": 1}))
    elif kind == "text":
        file.write_text("weights\n" * 20)
    elif kind == "folder":
        file.mkdir()
    missing = kind in ("folder", "nothing")
    with pytest.raises(FileNotFoundError if missing else ValueError, match="model") as caught:
        EnsembleDynamics.load(file)
    assert "\n" not in str(caught.value)
    if kind == "torch":  # as the model.pt of a run is
        assert "the model of a run is torchrl_l1.deployment.load_target(RUN_DIR)" in str(
            caught.value
        )


def test_others_can_read_the_tensors(tmp_path: Path) -> None:
    model = EnsembleDynamics(2, 1, 2, (4,))
    model.save(tmp_path / "model")
    tensors = load_file(tmp_path / "model")
    assert torch.equal(tensors["network.weights.0"], model.network.weights[0])
