"""L1 in pools of environments, in collectors with processes, compiled, and exported."""

from __future__ import annotations

import multiprocessing
from functools import partial

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import (
    AsyncEnvPool,
    CatTensors,
    Compose,
    GymEnv,
    PendulumEnv,
    StepCounter,
    TransformedEnv,
    UnsqueezeTransform,
)
from torchrl.envs.utils import step_mdp

from torchrl_l1.control import (
    ActionJacobian,
    L1Config,
    L1Controller,
    L1State,
    L1Transform,
    augment,
    init,
)
from torchrl_l1.control.state import state_names
from torchrl_l1.dynamics import EnsembleDynamics

CONFIG = L1Config(0.05, epsilon=0.5, action_low=-2.0, action_high=2.0)


class Model:
    """Changes of the observation with a known Jacobian, which needs no differentiation."""

    def mean_change(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.value_and_jacobian(observation, action)[0]

    def value_and_jacobian(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        value = 0.01 * observation + 0.1 * action.sin().expand_as(observation)
        jacobian = 0.1 * action.cos().unsqueeze(-2).expand(*observation.shape, 1)
        return value, jacobian


model = Model()


def act(observation: Tensor) -> Tensor:
    return 0.4 + 0.05 * observation[..., :1]


def make_env(seed: int | None = None) -> TransformedEnv:
    base = GymEnv("Pendulum-v1")
    env = TransformedEnv(base, Compose(L1Transform(model, CONFIG), StepCounter(4)))
    if seed is not None:
        env.set_seed(seed)
    return env


def make_primed_env() -> TransformedEnv:
    return TransformedEnv(
        GymEnv("Pendulum-v1"), Compose(make_controller().make_primer(), StepCounter(4))
    )


def make_controller() -> L1Controller:
    return L1Controller(model, CONFIG, observation_dim=3, action_dim=1)


def assert_is_the_core(data: TensorDictBase, u_rl: Tensor) -> None:
    """Every step is the core's, and each goes on where the last ended, over time the last axis."""
    state = L1State(**{name: data["l1", name] for name in state_names(CONFIG)})
    with torch.no_grad():
        u, following, _ = augment(CONFIG, ActionJacobian(model), state, data["observation"], u_rl)
    torch.testing.assert_close(data["next", "l1", "u_exec"], u, atol=1e-5, rtol=1e-5)
    begins = data["step_count"] == 0
    assert torch.equal(~data["l1", "started"], begins)
    for name, value in following.entries().items():
        found = data["next", "l1", name]
        torch.testing.assert_close(found, value, atol=1e-5, rtol=1e-5)
        goes_on = ~data["next", "done"][..., :-1, 0]
        continued = data["l1", name][..., 1:, :][goes_on]
        torch.testing.assert_close(continued, found[..., :-1, :][goes_on], atol=0, rtol=0)
    assert ((u - u_rl).abs() > 0.05).any() and begins.any()


@pytest.mark.usefixtures("forked_processes")
@pytest.mark.parametrize("backend", ["threading", "multiprocessing"])
def test_in_a_pool(backend):
    options = {"exchange": "queue"} if backend == "multiprocessing" else {}
    makers = [partial(make_env, seed) for seed in (0, 1)]
    pool = AsyncEnvPool(makers, backend=backend, stack="dense", **options)
    try:
        data, steps = pool.reset(), []
        for _ in range(4):
            data["action"] = act(data["observation"])
            data = pool.step(data)
            steps.append(data.exclude("env_index", ("next", "env_index")).clone())
            data = step_mdp(data)
        assert_is_the_core(torch.stack(steps, 1), torch.stack([s["action"] for s in steps], 1))
        # Without waiting for all.
        data["action"] = act(data["observation"])
        pool.async_step_and_maybe_reset_send(data)
        stepped, following = pool.async_step_and_maybe_reset_recv(min_get=2)
        assert stepped["l1", "started"].all() and not following["l1", "started"].any()
    finally:
        pool.close()


@pytest.mark.parametrize("kind", [MultiSyncCollector, MultiAsyncCollector])
@pytest.mark.parametrize("face", ["transform", "controller"])
def test_in_collectors_with_processes(kind, face, forked_processes):
    count = 2
    if (face, kind) == ("transform", MultiSyncCollector):
        # Once as TorchRL does it: the process loads everything anew.
        multiprocessing.set_start_method("spawn", force=True)
        count = 1
    policy = TensorDictModule(act, ["observation"], ["action"])
    make = make_env
    if face == "controller":
        policy, make = TensorDictSequential(policy, make_controller()), make_primed_env
    collector = kind(
        [make] * count,
        policy,
        frames_per_batch=24,
        total_frames=48,
        auto_register_policy_transforms=False,
    )
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        ids = batch["collector", "traj_ids"].unique()
        assert ids.numel() > 2
        u_rl = batch["action"] if face == "transform" else batch["l1", "u_rl"]
        rows = batch.reshape(-1, batch.shape[-1]) if batch.ndim > 1 else batch[None]
        assert_is_the_core(rows, u_rl.reshape(*rows.shape, 1))


class Robust(nn.Module):
    """A policy with L1, its state explicit: what a deployment needs."""

    def __init__(self, policy: nn.Module, dynamics: nn.Module) -> None:
        super().__init__()
        self.policy, self.dynamics = policy, dynamics
        self.config = CONFIG

    def forward(self, observation: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        jacobian = ActionJacobian(self.dynamics)
        u_rl = self.policy(observation)
        u, following, _ = augment(self.config, jacobian, L1State(*state), observation, u_rl)
        return u, *following.entries().values()


@torch.no_grad()
def test_policy_and_core_are_exported():
    torch.manual_seed(0)
    robust = Robust(nn.Linear(3, 1), EnsembleDynamics(3, 1, members=2, hidden=(8,))).eval()
    state = tuple(init([1], 3, 1).entries().values())
    program = torch.export.export(robust, (torch.zeros(1, 3), *state))
    exported, mine, theirs = program.module(), state, state
    for _ in range(5):
        observation = torch.randn(1, 3)
        u, *mine = robust(observation, *mine)
        found, *theirs = exported(observation, *theirs)
        torch.testing.assert_close(found, u)
    assert all(
        torch.allclose(a, b) for a, b in zip(mine, theirs, strict=True) if a.is_floating_point()
    )


# Tracing takes some seconds; a compiler behind it would add a minute and prove no more.
@pytest.mark.filterwarnings("ignore:A reset tensordict carrying state:FutureWarning")
def test_a_step_of_a_whole_environment_compiles_into_one_graph():
    torch.manual_seed(0)
    base = PendulumEnv()  # in torch; Gymnasium's would end the graph where it steps
    parts = ["th", "thdot"], ["angle", "rate"]
    vector = CatTensors(["angle", "rate"], "observation", del_keys=False)
    ensemble = EnsembleDynamics(2, 1, members=2, hidden=(8,)).eval()
    apart = UnsqueezeTransform(-1, in_keys=parts[0], out_keys=parts[1])
    chain = Compose(apart, vector, L1Transform(ensemble, epsilon=0.5))
    env = TransformedEnv(base, chain)

    def step(data: TensorDictBase) -> TensorDictBase:
        return env.step(data.set("action", act(data["observation"])))

    first = env.reset(base.gen_params(batch_size=[3]))
    compiled = torch.compile(step, backend="eager", fullgraph=True)
    mine = theirs = first
    for _ in range(4):
        mine, theirs = step(mine.clone()), compiled(theirs.clone())
        torch.testing.assert_close(theirs["next", "l1"], mine["next", "l1"], atol=0, rtol=0)
        mine, theirs = env.step_mdp(mine), env.step_mdp(theirs)
    assert (mine["l1", "q"] != 0).any()
    # The seal is checked there too.
    theirs["observation"] = theirs["observation"] + 1
    with pytest.raises(ValueError, match="is not what the environment gave"):
        compiled(theirs)
