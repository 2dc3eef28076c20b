"""Model-predictive control as a policy: plan, act, shift the plan, plan again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_l1.checks import check_count
from torchrl_l1.dynamics.functions import finite_bounds
from torchrl_l1.planning import cem, mppi, random_shooting
from torchrl_l1.planning.cem import CEMConfig
from torchrl_l1.planning.mppi import MPPIConfig
from torchrl_l1.planning.random_shooting import ShootingConfig
from torchrl_l1.planning.sequences import Plan, SequenceOptimizer
from torchrl_l1.planning.trajectory_sampling import TrajectorySampler

OptimizerConfig = CEMConfig | MPPIConfig | ShootingConfig

PLAN_KEY = "plan"
"""Default key of the nested tensordict that holds the planner's state."""

_OPTIMIZERS: dict[type[OptimizerConfig], SequenceOptimizer] = {
    CEMConfig: cem.plan,
    MPPIConfig: mppi.plan,
    ShootingConfig: random_shooting.plan,
}

# Largest number of entries in the candidates of environments planned for together (64 MiB).
_PORTION = 2**24


class ModelPredictiveController(TensorDictModuleBase):
    """Receding-horizon control with a learned model, as a policy (arXiv 1805.12114).

    It reads the observation and the planner's state. It writes the action and, under ``("next",
    key)``, the next state: ``mean``, the plan without the actions already taken and with the middle
    of the bounds appended, from which the next plan starts; ``step``, the number of actions since
    the reset; and ``best_return``, the best return that the last plan predicted. The environment
    needs the primer of :meth:`make_primer`, which starts the state at each reset and carries it
    from step to step, separately for each environment. If there is an entry ``is_init``
    (:class:`~torchrl.envs.InitTracker`), it restarts the state as well.

    The model is referenced, not registered: its weights are not among this module's parameters, and
    in-place updates take effect in the next plan. Plans are made on the model's device, wherever
    the observations are.

    Args:
        sampler: the model, the reward and how to use them.
        config: the optimiser's settings, whose type selects it.
        action_low: lower bounds of the actions, a single number or one per entry.
        action_high: upper bounds, likewise.
        replan_every: actions taken from a plan before the next one, counted from each reset.
        observation_key: key of the observation.
        action_key: key of the action.
        init_key: key of the flag for fresh resets.
        key: name of the nested tensordict that holds the planner's state.
        generator: source of randomness; torch's global one if ``None``.

    Raises:
        ValueError: for bounds that are empty or of the wrong width, ``replan_every`` outside the
            horizon, or a generator on another device than the model; on a call, for an observation
            or state of the wrong shape, or a reward that is not finite where the system is.
        KeyError: on a call, if the observation or the planner's state is missing.
        TypeError: for settings of an unknown kind.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_l1.dynamics import EnsembleDynamics
        >>> model = EnsembleDynamics(3, 1, hidden=(16,))
        >>> upright = TrajectorySampler(model, lambda x, u, successor: successor[..., 0])
        >>> config = CEMConfig(horizon=5, candidates=20, elites=4)
        >>> policy = ModelPredictiveController(upright, config, -2.0, 2.0)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), policy.make_primer())
        >>> data = env.rollout(4, policy)
        >>> data["action"].shape, data["plan", "mean"].shape
        (torch.Size([4, 1]), torch.Size([4, 5, 1]))
    """

    def __init__(
        self,
        sampler: TrajectorySampler,
        config: OptimizerConfig,
        action_low: float | Sequence[float] | Tensor,
        action_high: float | Sequence[float] | Tensor,
        *,
        replan_every: int = 1,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        init_key: NestedKey = "is_init",
        key: str = PLAN_KEY,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if type(config) not in _OPTIMIZERS:
            names = ", ".join(kind.__name__ for kind in _OPTIMIZERS)
            raise TypeError(f"config must be one of {names}, got {type(config).__name__}")
        check_count("replan_every", replan_every)
        if not replan_every <= config.horizon:
            raise ValueError(
                f"replan_every must be between 1 and the horizon {config.horizon}, got "
                f"{replan_every}"
            )
        device = sampler.dynamics.device
        if generator is not None and generator.device.type != device.type:
            raise ValueError(
                f"the generator is on {generator.device}, but plans are made on {device}, where "
                f"the model is: give torch.Generator({str(device)!r})"
            )
        self.sampler = sampler
        self.config = config
        self.replan_every = replan_every
        self.observation_key = observation_key
        self.action_key = action_key
        self.init_key = init_key
        self.key = key
        self.generator = generator
        zero = torch.zeros(1, config.horizon, sampler.dynamics.action_dim, dtype=torch.float32)
        low, high = (
            torch.as_tensor(bound, dtype=zero.dtype) for bound in (action_low, action_high)
        )
        self.action_low, self.action_high = finite_bounds(low, high, zero)
        self._spec = {
            "mean": (zero.shape[1:], torch.float32),
            "step": (torch.Size([1]), torch.int64),
            "best_return": (torch.Size([1]), torch.float32),
        }
        self.in_keys = [observation_key, init_key, (key, "mean"), (key, "step")]
        self.in_keys.append((key, "best_return"))
        self.out_keys = [action_key, *(("next", key, name) for name in self._spec)]

    def make_primer(self) -> TensorDictPrimer:
        """Transform that adds the planner's state to the environment, fresh at every reset."""
        spec = {name: Unbounded(shape, dtype=dtype) for name, (shape, dtype) in self._spec.items()}
        return TensorDictPrimer(Composite({self.key: Composite(spec)}), expand_specs=True)

    # The name under which torchrl.modules.utils.get_primers_from_module looks for it.
    make_tensordict_primer = make_primer

    @torch.no_grad()
    def plan(self, observation: Tensor, start: Tensor | None = None) -> Plan:
        """Plans for many observations, each made without state, as if just reset.

        Large numbers of observations are processed in portions, so that memory stays bounded.

        Args:
            observation: ``(N, n)``.
            start: initial sequences ``(N, H, m)``; the middle of the bounds if ``None``.

        Returns:
            The plans, float32, on the model's device. For an observation that is not finite, the
            plan is the initial sequence.

        Raises:
            ValueError: for no observations, wrong shapes, or a reward that is not finite where the
                system is.
        """
        dynamics = self.sampler.dynamics
        count, width = observation.shape[0] if observation.dim() else 0, dynamics.observation_dim
        if count == 0 or observation.shape != (count, width):
            raise ValueError(
                f"ModelPredictiveController.plan: observation must have shape (N, {width}) with at "
                f"least one row, got {tuple(observation.shape)}"
            )
        shape = (count, self.config.horizon, dynamics.action_dim)
        if start is None:
            start = self._middle().expand(shape)
        if start.shape != shape:
            raise ValueError(
                f"ModelPredictiveController.plan: start must have shape {shape} for these "
                f"observations and settings, got {tuple(start.shape)}"
            )
        if not torch.isfinite(start).all():
            raise ValueError("ModelPredictiveController.plan: start must be finite")
        optimize, device = _OPTIMIZERS[type(self.config)], dynamics.device
        observation, start = (part.to(device, torch.float32) for part in (observation, start))
        portion = max(1, _PORTION // (self.config.candidates * shape[1] * shape[2]))
        plans = []
        for x, mean in zip(observation.split(portion), start.split(portion), strict=True):
            evaluate = self.sampler.evaluator(x, self.generator)
            bounds = self.action_low, self.action_high
            planned = optimize(evaluate, mean, *bounds, self.config, self.generator)
            self._check_reward(x, mean[:, 0], planned.best_return)
            plans.append(planned)
        return Plan(*map(torch.cat, zip(*plans, strict=True)))

    def _middle(self) -> Tensor:
        return ((self.action_low + self.action_high) / 2).to(self.sampler.dynamics.device)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act, and plan when it is time to, see the class."""
        batch = tensordict.batch_size
        observation = self._observation(tensordict)
        count = batch.numel()
        dynamics = self.sampler.dynamics
        device = dynamics.device
        flat = observation.reshape(count, dynamics.observation_dim).to(device)
        mean, step, best_return = (
            self._state(tensordict, name).to(device).reshape(count, *shape)
            for name, (shape, _) in self._spec.items()
        )
        step = step[:, 0]
        restarted = tensordict.get(self.init_key, None)
        if restarted is not None:
            step = torch.where(restarted.reshape(count).to(device), 0, step)
        middle = self._middle()
        sequence = torch.where((step == 0)[:, None, None], middle, mean)
        due = (step % self.replan_every == 0).nonzero()[:, 0]
        if due.shape[0] > 0:
            planned = self.plan(flat[due], sequence[due])
            sequence = sequence.index_copy(0, due, planned.actions)
            best_return = best_return.index_copy(0, due, planned.best_return[:, None])
        following = {
            "mean": torch.cat([sequence[:, 1:], middle.expand_as(sequence[:, :1])], 1),
            "step": (step + 1)[:, None],
            "best_return": best_return,
        }
        action = sequence[:, 0].reshape(*batch, dynamics.action_dim)
        tensordict.set(self.action_key, action.to(observation.device))
        tensordict.set(
            ("next", self.key),
            TensorDict(
                {
                    name: value.reshape(*batch, *value.shape[1:]).to(observation.device)
                    for name, value in following.items()
                },
                batch_size=batch,
                device=tensordict.device,
            ),
        )
        return tensordict

    def _check_reward(self, observation: Tensor, action: Tensor, best_return: Tensor) -> None:
        """If no candidate has a finite return, find out whether the reward is to blame.

        A model may diverge everywhere; then the plan stays as it was.
        """
        failed = torch.isneginf(best_return)
        if not failed.any():
            return
        x, u = observation[failed], action[failed]
        for successor in (x, x + self.sampler.dynamics.mean_change(x, u)):
            reward = self.sampler.reward(x, u, successor)
            finite = torch.isfinite(x).all(-1) & torch.isfinite(successor).all(-1)
            bad = ~torch.isfinite(reward) & finite
            if bad.any():
                raise ValueError(
                    "ModelPredictiveController: the reward function gives "
                    f"{reward[bad][0].item()} at the observation {x[bad][0].tolist()} with the "
                    f"action {u[bad][0].tolist()} and the next observation "
                    f"{successor[bad][0].tolist()}; planning needs rewards that are finite"
                )

    def _observation(self, tensordict: TensorDictBase) -> Tensor:
        observation = tensordict.get(self.observation_key, None)
        if observation is None:
            found = sorted(map(str, tensordict.keys()))
            raise KeyError(
                f"ModelPredictiveController found no {self.observation_key!r} in the tensordict, "
                f"only {found}"
            )
        expected = (*tensordict.batch_size, self.sampler.dynamics.observation_dim)
        if tuple(observation.shape) != expected:
            raise ValueError(
                f"ModelPredictiveController: {self.observation_key!r} has shape "
                f"{tuple(observation.shape)}, expected {expected} for its model"
            )
        if observation.dtype != torch.float32:
            raise ValueError(
                f"ModelPredictiveController: {self.observation_key!r} is {observation.dtype}, but "
                "plans are float32: append DoubleToFloat() to the environment"
            )
        return observation

    def _state(self, tensordict: TensorDictBase, name: str) -> Tensor:
        value: Any = tensordict.get((self.key, name), None)
        if value is None:
            raise KeyError(
                f"ModelPredictiveController found no {(self.key, name)!r}: append the primer to "
                "the environment, TransformedEnv(env, controller.make_primer())"
            )
        expected = (*tensordict.batch_size, *self._spec[name][0])
        if tuple(value.shape) != expected:
            raise ValueError(
                f"ModelPredictiveController: {(self.key, name)!r} has shape "
                f"{tuple(value.shape)}, expected {expected}"
            )
        return value
