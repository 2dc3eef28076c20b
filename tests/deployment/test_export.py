from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_l1.deployment import RobustController, export
from torchrl_l1.deployment.export import cholesky, cholesky_solve, solve_triangular
from torchrl_l1.deployment.policies import load_policy

# What torch says of its own exporters.
pytestmark = pytest.mark.filterwarnings("ignore")


def with_policy(robust: RobustController, policy) -> RobustController:
    acting = load_policy(policy, robust.source.one())
    return RobustController(robust.source, acting, robust.model, robust.configs)


@pytest.mark.parametrize("preset", ["robust", "paper"])
def test_torchscript_acts_as_the_transform(robust, tmp_path, preset):
    found = export(robust, tmp_path / "policy.pt", preset=preset, steps=30)
    step = torch.jit.load(str(found.file))
    env = robust.wrap(robust.source.single({"bias": 0.5}), preset)
    data = env.rollout(25, robust.policy)[0]
    state = [data["l1", name][:1] for name in found.inputs[1:]]
    assert not any(entry.any() for entry in state)  # it begins with zeros
    for row in data:
        action, *state = step(row["observation"][None], *state)
        torch.testing.assert_close(action[0], row["next", "l1", "u_exec"], atol=1e-5, rtol=0)
    for name, entry in zip(found.outputs[1:], state, strict=True):
        expected = data["next", "l1", name.removeprefix("next_")][-1]
        torch.testing.assert_close(entry[0], expected, atol=1e-4, rtol=1e-4)


def test_exported_programs_can_do_without_the_policy(robust, tmp_path):
    found = export(robust, tmp_path / "l1.pt2", with_policy=False, steps=10)
    assert found.inputs[:2] == ("observation", "u_rl") and found.error < 1e-5


def test_as_many_steps_are_named_as_were_compared(robust, tmp_path):
    """An episode ends before, after 100 steps at the latest."""
    found = export(robust, tmp_path / "policy.pt", steps=5000)
    data = robust.wrap(robust.source.one()).rollout(5000, robust.policy)
    assert 1 <= found.steps <= 100 == max(100, data.shape[-1])


def test_onnx_acts_as_the_original(robust, tmp_path):
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    found = export(robust, tmp_path / "policy.onnx", steps=20)
    assert found.error < 1e-4


def test_what_is_not_made_of_torchs_operations_is_refused(robust, tmp_path):
    numpy = with_policy(robust, lambda x: np.tanh(np.asarray(x))[..., :1])
    with pytest.raises(ValueError, match="without-policy"):
        export(numpy, tmp_path / "policy.pt", steps=10)
    assert export(numpy, tmp_path / "l1.pt", with_policy=False, steps=10).error < 1e-5


def test_other_suffixes_are_refused(robust, tmp_path):
    with pytest.raises(ValueError, match="format"):
        export(robust, tmp_path / "policy.json")


def test_sampling_policies_export_their_mean(robust, tmp_path):
    network = torch.nn.Sequential(torch.nn.Linear(4, 2), torch.nn.Tanh())
    from tensordict.nn import NormalParamExtractor, TensorDictModule

    module = TensorDictModule(
        torch.nn.Sequential(network, NormalParamExtractor()), ["observation"], ["loc", "scale"]
    )
    actor = ProbabilisticActor(
        module, ["loc", "scale"], ["action"], distribution_class=IndependentNormal,
    )  # fmt: skip
    found = export(with_policy(robust, actor), tmp_path / "policy.pt", steps=10)
    assert found.error < 1e-5


@pytest.mark.parametrize("size", [1, 3, 6])
def test_unrolled_algebra_is_that_of_torch(size):
    torch.manual_seed(size)
    root = torch.randn(2, size, size, dtype=torch.float64)
    matrix = root @ root.mT + torch.eye(size)
    right = torch.randn(2, size, 2, dtype=torch.float64)
    factor, info = cholesky(matrix)
    torch.testing.assert_close(factor, torch.linalg.cholesky(matrix))
    assert not info.any() and cholesky(-matrix)[1].all()
    for upper in (False, True):
        triangle = factor.mT if upper else factor
        expected = torch.linalg.solve_triangular(triangle, right, upper=upper)
        torch.testing.assert_close(solve_triangular(triangle, right, upper=upper), expected)
    torch.testing.assert_close(cholesky_solve(right, factor), torch.linalg.solve(matrix, right))
