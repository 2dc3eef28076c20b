"""Pipelines that record what passes on both sides of L1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    ObservationNorm,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import step_mdp

from torchrl_l1.control import ActionJacobian, L1Config, L1Controller, L1Transform, augment, init

Make = Callable[[], Any]
STEPS, EPSILON = 8, 0.5


def model(observation: Tensor, action: Tensor) -> Tensor:
    return 0.01 * observation + 0.1 * action.sin().expand_as(observation)


def act(observation: Tensor) -> Tensor:
    return 0.4 + 0.05 * observation[..., :1].float().clamp(-2.0, 2.0)


def actor(key: str = "observation") -> TensorDictModule:
    return TensorDictModule(act, [key], ["action"])


def normaliser(**keys: Any) -> ObservationNorm:
    return ObservationNorm(5.0, 0.1, in_keys=["observation"], **keys)


class Identity(nn.Module):
    """A policy's own layer that writes to its own key."""

    def forward(self, observation: Tensor) -> Tensor:
        return (observation - 5.0) / 0.1


class Record(Transform):
    """What passes here: observations on their way out, actions on their way in."""

    def __init__(self, events: list[tuple[str, Tensor]]) -> None:
        super().__init__()
        self.events = events

    def _note(self, what: str, data: TensorDictBase, key: str = "observation") -> TensorDictBase:
        self.events.append((what, data[key].detach().clone()))
        return data

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._note("action", tensordict, "action")

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._note("step", next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._note("reset", tensordict_reset)


def assert_is_the_core(
    inner: Sequence[tuple[str, Tensor]], asked: Sequence[Tensor], dt: float, reads: Make = lambda: 0
) -> int:
    """What came in at ``inner`` is what the core makes of ``asked``; returns how much was added."""
    config = L1Config(dt, epsilon=EPSILON, action_low=-2.0, action_high=2.0)
    jacobian, state, added = ActionJacobian(model), init([], 3, 1), []
    asked, observation = list(asked), torch.zeros(3)
    for what, value in inner:
        if what != "action":
            observation = value.float()
            state = init([], 3, 1) if what == "reset" else state
            continue
        u_rl = asked.pop(0)
        with torch.no_grad():
            u, state, _ = augment(config, jacobian, state, observation, u_rl)
        torch.testing.assert_close(value, u, atol=1e-5, rtol=1e-5)
        added.append((u - u_rl).abs())
    assert not asked and torch.stack(added).max() > 0.05
    return len(added)


pendulum = partial(GymEnv, "Pendulum-v1")


class Pipeline:
    """``Compose(*before, L1, *after)`` around an environment, or in workers, inside ``outside``."""

    def __init__(
        self,
        face: str = "transform",
        before: Sequence[Make] = (),
        after: Sequence[Make] = (),
        outside: Sequence[Make] = (),
        module: TensorDictModuleBase | None = None,
        policy: TensorDictModuleBase | None = None,
        workers: int = 0,
        base: Callable[[], EnvBase] = pendulum,
        **settings: Any,
    ) -> None:
        self.events: list[tuple[list, list]] = []
        self.face, self.before, self.after, self.base = face, before, after, base
        self.settings = {"epsilon": EPSILON, **settings}
        modules = [policy or actor()] if module is None else [module, policy or actor()]
        if face == "controller":
            dims = {"observation_dim": 3, "action_dim": 1}
            self.controller = L1Controller(model, **dims, **self.settings)
            modules.append(self.controller)
        self.policy = TensorDictSequential(*modules)
        env = SerialEnv(workers, self.make) if workers else self.make()
        if outside:
            env = TransformedEnv(env, Compose(*(make() for make in outside)), auto_unwrap=False)
        env.set_seed(0)
        self.env = env

    def make(self) -> TransformedEnv:
        inner: list = []
        outer: list = []
        self.events.append((inner, outer))
        before, after = ([make() for make in makes] for makes in (self.before, self.after))
        if self.face == "controller":
            chain = [*before, self.controller.make_primer(), *after, Record(inner)]
        else:
            l1 = L1Transform(model, **self.settings)
            chain = [*before, Record(inner), l1, Record(outer), *after]
        return TransformedEnv(self.base(), Compose(*chain))

    def collect(self, how: str) -> TensorDictBase:
        if how == "rollout":
            return self.env.rollout(STEPS, self.policy, break_when_any_done=False)
        if how == "collector":
            options = {"frames_per_batch": STEPS // 2, "total_frames": STEPS}
            collector = Collector(
                self.env, self.policy, **options, auto_register_policy_transforms=False
            )
            data = torch.cat(list(collector), -1)
            collector.shutdown()
            return data
        steps, data = [], self.env.reset()
        for _ in range(STEPS):
            data = self.env.step(self.policy(data))
            steps.append(data.clone())
            data = self.env.step_mdp(data) if how == "env.step_mdp" else step_mdp(data)
        return torch.stack(steps, steps[0].ndim)

    def check(self, data: TensorDictBase, dt: float = 0.05) -> None:
        self.events = [pair for pair in self.events if pair[0]]
        assert self.events
        for row, (inner, outer) in enumerate(self.events):
            asked = [value for what, value in outer if what == "action"]
            if self.face == "controller":
                u_rl = data["l1", "u_rl"]
                asked = list(u_rl if u_rl.ndim == 2 else u_rl[row])
            assert_is_the_core(inner, asked, dt)


BOTH = ("transform", "controller")
two = {"workers": 2}
