"""METRPO, model-ensemble trust region policy optimisation, with or without L1 in the loop.

Each outer iteration fits an ensemble to all real transitions so far, improves the policy by TRPO
on imagined trajectories, and collects real trajectories with the new policy (arXiv 1802.10592).
With L1 on, the adaptive controller augments the policy's action during collection; the rest of
the algorithm does not know of it (arXiv 2403.14860, algorithm 2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from functools import partial
from itertools import pairwise
from time import perf_counter
from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchrl_l1.algorithms.algorithm import IterationResult, resolve_device, seed_streams
from torchrl_l1.algorithms.collection import Collection, policy_returns, signal_metrics
from torchrl_l1.algorithms.metrics import fit_metrics
from torchrl_l1.algorithms.metrpo_config import METRPOConfig, check_clipping
from torchrl_l1.algorithms.metrpo_metrics import policy_metrics
from torchrl_l1.algorithms.model_learning import ModelLearning
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.algorithms.policy_improvement import PolicyImprovement
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import make_dynamics
from torchrl_l1.envs import Perturbation, get_task


class METRPO:
    """The algorithm and its state; :meth:`iterate` is the loop.

    Args:
        task: name of a task, see :data:`torchrl_l1.envs.TASKS`.
        config: settings.
        l1: the adaptive controller used in collection; ``None`` for none.
        perturbation: noise and disturbances of the real environment.
        seed: seed of every random stream. Streams are derived anew from the seed and the
            iteration's number, so that a resumed run draws what an unbroken one would have.
        horizon: steps per real episode; the task's own by default.
        device: where models are fitted and trajectories imagined: ``cpu``, ``cuda`` or ``auto``.
            Real environments, and the copies of policy and model that act in them, are on the
            CPU.
        compile_l1: whether to compile the controller's step, see
            :class:`~torchrl_l1.control.L1Transform`.
        on_phase: called with a word on what is going on, for progress bars.

    Raises:
        ValueError: if L1 is on and ``clip_actions`` is off.
    """

    def __init__(
        self,
        task: str,
        config: METRPOConfig,
        l1: L1Config | None = None,
        perturbation: Perturbation | None = None,
        seed: int = 0,
        horizon: int | None = None,
        device: str = "cpu",
        compile_l1: CompileMode = False,
        on_phase: Callable[[str], None] | None = None,
    ) -> None:
        check_clipping(config.clip_actions, l1 is not None)
        self.config, self.seed = config, seed
        self.device = resolve_device(device)
        self.on_phase = on_phase or (lambda phase: None)
        self.task = get_task(task)
        n, m = self.task.observation_dim, self.task.action_dim
        seed_streams(seed, "initialisation")
        self.dynamics = make_dynamics(n, m, **vars(config.model)).to(self.device)
        self.policy = GaussianPolicy(n, m, config.policy.hidden, config.policy.std).to(self.device)
        self.improvement = PolicyImprovement(self.task, self.dynamics, self.policy, config)
        on_cpu = self.device.type == "cpu"
        self.acting_policy = self.policy if on_cpu else deepcopy(self.policy).cpu()
        self.acting_dynamics = self.dynamics if on_cpu else deepcopy(self.dynamics).cpu()
        real = partial(
            Collection,
            self.task,
            policy=acting(self.acting_policy, self.task, config.clip_actions),
            dynamics=self.acting_dynamics,
            l1=l1,
            perturbation=perturbation or Perturbation(),
            compile_l1=compile_l1,
        )
        full = horizon or self.task.horizon
        self.collection = real(
            episodes=config.episodes_per_iteration, horizon=min(config.episode_steps or full, full)
        )
        self.evaluation = real(episodes=config.evaluation_episodes, horizon=full)
        capacity = (config.outer_iterations + 1) * self.collection.frames
        self.learning = ModelLearning(self.dynamics, config.fit, config.label, capacity)
        self.iteration = 0

    def iterate(self) -> Iterator[IterationResult]:
        """Run the outer iterations that are left, reporting after each."""
        config = self.config
        while self.iteration < config.outer_iterations:
            seed_streams(self.seed, "iteration", self.iteration)
            clock = [perf_counter()]
            if len(self.learning.buffer) == 0:
                self.on_phase("random data")
                self.learning.store(self.collection.random(self.seed))
            clock.append(perf_counter())

            fit = self.learning.fit(lambda epoch: self.on_phase(f"fit, epoch {epoch}"))
            clock.append(perf_counter())

            if config.policy.normalize:
                self.policy.normalizer.fit(self.learning.buffer[:]["observation"])
            if config.policy.reset_std:
                self.policy.reset_std(config.policy.std)
            steps = []
            for step in range(config.trpo_iterations):
                self.on_phase(f"TRPO {step + 1}/{config.trpo_iterations}")
                steps.append(self.improvement.step(self.learning.buffer))
            clock.append(perf_counter())

            self.on_phase("collecting")
            self.acting_policy.load_state_dict(self.policy.state_dict())
            self.acting_dynamics.load_state_dict(self.dynamics.state_dict())
            data = self.collection.collect(self.seed, self.iteration)
            self.learning.store(data)
            clock.append(perf_counter())
            self.on_phase("evaluating")
            returns = policy_returns(
                data, self.collection, self.evaluation, self.seed, self.iteration
            )
            clock.append(perf_counter())

            metrics = {
                "iteration": self.iteration,
                "real_steps": (self.iteration + 2) * self.collection.frames,
                **returns,
                **signal_metrics(data),
                **fit_metrics(fit),
                **policy_metrics(steps),
                "policy/std": self.policy.log_std.detach().exp().mean().item(),
            }
            self.iteration += 1
            phases = ("random", "fit", "trpo", "collect", "evaluate")
            seconds = [after - before for before, after in pairwise(clock)]
            yield IterationResult(metrics, dict(zip(phases, seconds, strict=True)))

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """What acts in real environments: the policy, its actions clipped if settings say so."""
        return {"policy": self.collection.policy}

    def choices(self) -> dict[str, str]:
        """Where models are fitted and trajectories imagined."""
        return {"device": str(self.device)}

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dicts of model and policy."""
        return {"model": self.dynamics.state_dict(), "policy": self.policy.state_dict()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {
            "iteration": self.iteration,
            "policy": self.policy.state_dict(),
            "improvement": self.improvement.state_dict(),
            **self.learning.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.iteration = state["iteration"]
        self.policy.load_state_dict(state["policy"])
        self.improvement.load_state_dict(state["improvement"])
        self.learning.load_state_dict(state)
