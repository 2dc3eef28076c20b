from __future__ import annotations

import math
import shutil
import sys
import sysconfig
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch._dynamo.exc import TorchDynamoException
from torchrl.data import Composite, OneHot, Unbounded

from torchrl_l1.control import ActionJacobian, L1Config, augment, init, law
from torchrl_l1.control.affine import BLOCK, make_step
from torchrl_l1.control.layout import Layout
from torchrl_l1.dynamics import EnsembleDynamics

HEADERS = Path(sysconfig.get_path("include")) / "Python.h"
needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None or not HEADERS.exists() or sys.platform == "win32",
    reason="no working C++ compiler",
)


def trajectory(step, n: int = 4, m: int = 1):
    generator = torch.Generator().manual_seed(0)
    state, history = init([3], n, m), []
    for _ in range(5):
        x = torch.randn(3, n, generator=generator)
        u_rl = torch.randn(3, m, generator=generator)
        u, state, _ = step(state, x, u_rl)
        history.append(torch.cat([u, state.x_hat], -1))
    return torch.stack(history)


@needs_compiler
@torch.no_grad()
def test_compiled_step_agrees_and_sees_weights_updated_in_place():
    torch.manual_seed(0)
    model = EnsembleDynamics(4, 1, members=2, hidden=(8, 8))
    config = L1Config(0.04, epsilon=0.05, action_low=-1.0, action_high=1.0)
    step = make_step(config, ActionJacobian(model), True)
    eager = make_step(config, ActionJacobian(model), False)
    before = trajectory(step)
    torch.testing.assert_close(before, trajectory(eager), atol=1e-5, rtol=1e-5)
    for weight in model.parameters():
        weight.mul_(1.5)
    after = trajectory(step)
    torch.testing.assert_close(after, trajectory(eager), atol=1e-5, rtol=1e-5)
    assert not torch.allclose(before, after)


@pytest.mark.parametrize("batch", [(2 * BLOCK + 5,), (3, 100), ()])
@torch.no_grad()
def test_blocks_of_rows_are_the_batch(batch):
    torch.manual_seed(0)
    model = EnsembleDynamics(4, 2, members=2, hidden=(16, 16))
    config = L1Config(0.04, epsilon=0.05, action_low=-1.0, action_high=1.0)
    sizes = []
    expansion = model.expansion

    def counting(observation, *actions):
        sizes.append(observation.shape[:-1].numel())
        return expansion(observation, *actions)

    model.expansion = counting
    step = make_step(config, ActionJacobian(model), False)
    states = [init(batch, 4, 2)] * 2
    for _ in range(4):
        x, u_rl = torch.randn(*batch, 4), torch.randn(*batch, 2)
        sizes.clear()
        blocked = step(states[0], x, u_rl)
        assert sum(sizes) == math.prod(batch) and max(sizes) <= BLOCK
        results = (blocked, augment(config, ActionJacobian(model), states[1], x, u_rl))
        flat = [(u, *state.entries().values(), *signals) for u, state, signals in results]
        for found, expected in zip(*flat, strict=True):
            assert found.shape == expected.shape and found.dtype == expected.dtype
            torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)
        states = [state for _, state, _ in results]


@torch.no_grad()
def test_a_model_of_another_kind_sees_the_whole_batch():
    gains = torch.rand(2 * BLOCK, 1)
    step = make_step(L1Config(0.04), ActionJacobian(lambda x, u: gains * u + 0.1 * x), False)
    u, state, _ = step(init([2 * BLOCK], 1, 1), torch.zeros(2 * BLOCK, 1), torch.ones(2 * BLOCK, 1))
    assert torch.equal(u, torch.ones_like(u))
    torch.testing.assert_close(state.x_hat, gains)


@torch.no_grad()
@pytest.mark.parametrize("spec", [OneHot(3, dtype=torch.float32), Unbounded((3,))])
def test_actions_that_are_a_choice_are_refused(spec):
    observation = Composite(observation=Unbounded((3,)))
    specs = {"full_observation_spec": observation, "full_action_spec": Composite(action=spec)}
    env = SimpleNamespace(**specs, batch_size=torch.Size([]), device=None)
    if isinstance(spec, Unbounded):
        assert Layout.of(env, "observation", "action").action_dim == 3
        return
    with pytest.raises(ValueError, match="as action 'action', but its spec is OneHot"):
        Layout.of(env, "observation", "action")


def test_without_diagnostics_they_are_not_computed(monkeypatch):
    model = ActionJacobian(EnsembleDynamics(4, 1, members=2, hidden=(8,)))
    config = L1Config(0.04, epsilon=0.05, action_low=-1.0, action_high=1.0)
    expected = trajectory(make_step(config, model, False))
    monkeypatch.setattr(law, "diagnose", None)
    silent = make_step(config, model, False, diagnostics=False)
    assert silent(init([3], 4, 1), torch.zeros(3, 4), torch.zeros(3, 1))[2] is None
    assert torch.equal(trajectory(silent), expected)


@torch.no_grad()
def test_auto_falls_back_silently_without_a_compiler(monkeypatch, capfd):
    def broken(function, **options):
        assert options == {"fullgraph": True, "dynamic": False}

        def call(*args):
            raise TorchDynamoException("no compiler")

        return call

    monkeypatch.setattr(torch, "compile", broken)
    model = ActionJacobian(lambda x, u: 0.1 * x + u.sin())
    config = L1Config(0.04)
    step = make_step(config, model, "auto")
    expected = trajectory(lambda *args: augment(config, model, *args))
    torch.testing.assert_close(trajectory(step), expected, atol=0, rtol=0)
    assert capfd.readouterr() == ("", "")
    with pytest.raises(TorchDynamoException, match="no compiler"):
        trajectory(make_step(config, model, True))


@torch.no_grad()
def test_auto_reports_the_fault_of_the_arguments_not_the_compilers(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    step = make_step(L1Config(0.04), ActionJacobian(lambda x, u: x[..., :1]), "auto")
    with pytest.raises(ValueError, match="the dynamics returned shape"):
        step(init([3], 4, 1), torch.zeros(3, 4), torch.zeros(3, 1))


@torch.no_grad()
def test_many_controllers_compile_in_one_process(monkeypatch):
    # torch refuses more graphs than this, eight by default, for one code object.
    limit = torch._dynamo.config.patch(recompile_limit=2)
    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return graph

    real = torch.compile
    monkeypatch.setattr(
        torch, "compile", lambda function, **options: real(function, backend=backend, **options)
    )
    model = ActionJacobian(lambda x, u: 0.1 * x + u.sin())
    with limit:
        for k in range(3):
            config = L1Config(0.01 * (k + 1))
            batch = k % 3 + 1
            found, expected = init([batch], 3, 1), init([batch], 3, 1)
            step = make_step(config, model, True)
            for _ in range(3):
                x, u_rl = torch.randn(batch, 3), torch.randn(batch, 1)
                u, found, _ = step(found, x, u_rl)
                u_expected, expected, _ = augment(config, model, expected, x, u_rl)
                torch.testing.assert_close(u, u_expected)
                torch.testing.assert_close(found.x_hat, expected.x_hat)
    assert len(graphs) == 3
