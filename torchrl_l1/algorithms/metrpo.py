"""METRPO, model-ensemble trust region policy optimisation, with or without L1 in the loop.

Each outer iteration fits an ensemble to all real transitions so far, improves the policy by TRPO
on imagined trajectories, and collects real trajectories with the new policy (arXiv 1802.10592).
With L1 on, the adaptive controller augments the policy's action during collection; the rest of
the algorithm does not know of it (arXiv 2403.14860, algorithm 2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import fmean
from time import perf_counter
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from torchrl_l1.algorithms.collection import Collection, Perturbation, episode_returns
from torchrl_l1.algorithms.policy import GaussianPolicy, clipped, make_actor
from torchrl_l1.algorithms.seeding import seed_streams
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, FitReport, fit_ensemble, imagine
from torchrl_l1.envs import StartStates, get_task
from torchrl_l1.objectives import LinearFeatureBaseline, TRPOConfig, TRPOReport, trpo_step

METRICS: dict[str, str] = {
    "iteration": "Outer iteration, from 0.",
    "real_steps": "Real environment steps so far, the initial random ones included.",
    "return_mean": "Mean return of this iteration's real episodes: the stochastic policy, with L1 "
    "if it is on. These episodes join the data. The paper's figure of merit.",
    "return_std": "Standard deviation over these episodes.",
    "return_min": "Lowest return among them.",
    "return_max": "Highest return among them.",
    "return_deterministic": "Mean return of as many extra episodes with the policy's mean action "
    "(and L1 if it is on). These do not join the data and are not counted as real steps.",
    "episodes": "Number of real episodes finished in this iteration.",
    "non_finite_steps": "Real steps on which the simulator's state became non-finite; they end "
    "the episode and are kept out of the data.",
    "model/train_loss": "Mean training loss of a member in the last epoch, normalised units.",
    "model/validation_loss": "Mean over members of the lowest validation loss, the weights kept.",
    "model/epochs": "Passes over the training data.",
    "model/gradient_steps": "Adam steps.",
    "imagined/return_first": "Mean imagined return before the first TRPO step.",
    "imagined/return_last": "Mean imagined return before the last TRPO step.",
    "imagined/left_box": "Share of imagined trajectories that left the box around the data, in "
    "the last TRPO step. High values mean that the policy exploits the model.",
    "trpo/kl": "Mean KL divergence per TRPO step, nats.",
    "trpo/improvement": "Mean gain of the surrogate per TRPO step.",
    "trpo/accepted": "Share of TRPO steps whose line search succeeded.",
    "policy/std": "Mean standard deviation of the policy at collection, action units.",
    "l1/switch_rate": "Switches of the operating point per real step.",
    "l1/affinization_error": "Mean distance between model and affine model at the tested input, "
    "raw state units, before switching.",
    "l1/affinization_error_max": "Largest such distance.",
    "l1/prediction_error": "Mean norm of the predictor's error x_hat - x, raw state units.",
    "l1/prediction_error_max": "Largest such norm.",
    "l1/matched": "Mean norm of the matched part of the estimate, state units per second.",
    "l1/matched_max": "Largest such norm.",
    "l1/unmatched": "Mean norm of the unmatched estimate, state units per second. It is "
    "estimated, not cancelled.",
    "l1/unmatched_max": "Largest such norm.",
    "l1/u_a": "Mean norm of the adaptive input, action units.",
    "l1/u_a_max": "Largest such norm.",
    "l1/saturation": "Share of steps on which the executed input met a bound.",
    "l1/ill_conditioned": "Share of steps with a rank-deficient or ill-conditioned Jacobian.",
}
"""Every metric that :class:`METRPO` reports, with its meaning. ``l1/...`` only with L1 on."""


@dataclass
class ModelConfig:
    """Size of the ensemble, see :class:`~torchrl_l1.dynamics.EnsembleDynamics`."""

    members: int = 5
    hidden: list[int] = field(default_factory=lambda: [256, 256])
    activation: str = "relu"
    std_floor: float = 1e-4
    box_margin: float = 0.5


@dataclass
class PolicyConfig:
    """The policy's network and its standard deviation at the start of each outer iteration."""

    hidden: list[int] = field(default_factory=lambda: [32, 32])
    std: float = 1.0
    reset_std: bool = True


@dataclass
class METRPOConfig:
    """Settings of :class:`METRPO`.

    Attributes:
        outer_iterations: rounds of fit, policy improvement and collection.
        episodes_per_iteration: real episodes per round (and of random data before the first),
            run side by side.
        trpo_iterations: TRPO steps per round.
        imagined_steps: imagined transitions per TRPO step.
        imagined_horizon: length of an imagined trajectory.
        imagined_from_data: share of the imagined trajectories that start from states in the
            real data; the others start as the task does. Where the imagined horizon is shorter
            than the task's, later states are never imagined otherwise.
        discount: gamma.
        gae_lambda: lambda of the generalized advantage estimate.
        label: action that the model is fitted to: ``nominal`` is the policy's (the paper's
            choice), ``executed`` what the actuators received after L1.
        model: see :class:`ModelConfig`.
        policy: see :class:`PolicyConfig`.
        fit: see :class:`~torchrl_l1.dynamics.FitConfig`.
        trpo: see :class:`~torchrl_l1.objectives.TRPOConfig`.
    """

    outer_iterations: int = 33
    episodes_per_iteration: int = 6
    trpo_iterations: int = 20
    imagined_steps: int = 50_000
    imagined_horizon: int = 200
    imagined_from_data: float = 0.0
    discount: float = 0.99
    gae_lambda: float = 0.95
    label: str = "nominal"
    model: ModelConfig = field(default_factory=ModelConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    trpo: TRPOConfig = field(default_factory=TRPOConfig)


@dataclass
class PolicyStep:
    """One TRPO step: its report, and what the trajectories that it learnt from were like."""

    report: TRPOReport
    imagined_return: float
    left_box: float


@dataclass
class IterationResult:
    """What an outer iteration reports: metrics, and wall-clock seconds by phase."""

    metrics: dict[str, float]
    seconds: dict[str, float]


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
        on_phase: called with a word on what is going on, for progress bars.
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
        on_phase: Callable[[str], None] | None = None,
    ) -> None:
        if config.label not in ("nominal", "executed"):
            raise ValueError(f"label must be 'nominal' or 'executed', got {config.label!r}")
        self.config, self.seed = config, seed
        self.device = resolve_device(device)
        self.on_phase = on_phase or (lambda phase: None)
        self.task = get_task(task)
        n, m = self.task.observation_dim, self.task.action_dim
        seed_streams(seed, "initialisation")
        model, policy = config.model, config.policy
        self.dynamics = EnsembleDynamics(
            n,
            m,
            model.members,
            model.hidden,
            model.activation,  # type: ignore[arg-type]
            model.std_floor,
            model.box_margin,
        ).to(self.device)
        self.policy = GaussianPolicy(n, m, policy.hidden, policy.std).to(self.device)
        self.actor = make_actor(self.policy)
        self.baseline = LinearFeatureBaseline(n).to(self.device)
        self.optimizer = torch.optim.Adam(
            self.dynamics.parameters(), lr=config.fit.learning_rate, fused=True
        )
        self.action_low = torch.full((m,), self.task.action_low, device=self.device)
        self.action_high = torch.full((m,), self.task.action_high, device=self.device)
        on_cpu = self.device.type == "cpu"
        self.acting_policy = self.policy if on_cpu else deepcopy(self.policy).cpu()
        self.acting_dynamics = self.dynamics if on_cpu else deepcopy(self.dynamics).cpu()
        self.start_states = StartStates(self.task)
        self.collection = Collection(
            self.task,
            config.episodes_per_iteration,
            clipped(make_actor(self.acting_policy), self.action_low.cpu(), self.action_high.cpu()),
            self.acting_dynamics,
            l1,
            perturbation or Perturbation(),
            horizon,
        )
        frames = self.collection.frames
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage((config.outer_iterations + 1) * frames),
            batch_size=config.fit.batch_size,
        )
        self.iteration = 0

    def iterate(self) -> Iterator[IterationResult]:
        """Run the outer iterations that are left, reporting after each."""
        config = self.config
        while self.iteration < config.outer_iterations:
            seed_streams(self.seed, "iteration", self.iteration)
            clock = [perf_counter()]
            if len(self.buffer) == 0:
                self.on_phase("random data")
                self.store(self.collection.random(self.seed))
            clock.append(perf_counter())

            fit = fit_ensemble(
                self.dynamics,
                self.buffer,
                config.fit,
                self.optimizer,
                action_key="action" if config.label == "nominal" else "executed",
                on_epoch=lambda epoch: self.on_phase(f"fit, epoch {epoch}"),
            )
            clock.append(perf_counter())

            if config.policy.reset_std:
                self.policy.reset_std(config.policy.std)
            steps = []
            for step in range(config.trpo_iterations):
                self.on_phase(f"TRPO {step + 1}/{config.trpo_iterations}")
                steps.append(self.improve_policy())
            clock.append(perf_counter())

            self.on_phase("collecting")
            self.acting_policy.load_state_dict(self.policy.state_dict())
            self.acting_dynamics.load_state_dict(self.dynamics.state_dict())
            data = self.collection.collect(self.seed, self.iteration)
            self.store(data)
            clock.append(perf_counter())
            deterministic = episode_returns(self.collection.evaluate(self.seed, self.iteration))
            clock.append(perf_counter())

            metrics = {
                "iteration": self.iteration,
                "real_steps": (self.iteration + 2) * self.collection.frames,
                **self.collection.metrics(data),
                "return_deterministic": deterministic.mean().item(),
                **_fit_metrics(fit),
                **_policy_metrics(steps),
                "policy/std": self.policy.log_std.detach().exp().mean().item(),
            }
            self.iteration += 1
            phases = ("random", "fit", "trpo", "collect", "evaluate")
            seconds = [after - before for before, after in pairwise(clock)]
            yield IterationResult(metrics, dict(zip(phases, seconds, strict=True)))

    def store(self, data: TensorDictBase) -> None:
        """Add real transitions ``[N, T]``, a fixed share of them marked for validation."""
        flat = data.reshape(-1)
        flat = flat[~flat["next", "non_finite"].squeeze(-1)]
        items = flat.select(
            "observation", "action", "executed", ("next", "observation"), ("next", "reward")
        )
        items["validation"] = torch.rand(items.shape[0]) < self.config.fit.validation_fraction
        self.buffer.extend(items)

    def improve_policy(self) -> PolicyStep:
        """One TRPO step on fresh imagined trajectories; the baseline is refitted after it."""
        config = self.config
        trajectories = imagine(
            self.dynamics,
            self.policy.sample,
            self.task.imagined_reward,
            self.imagined_starts(config.imagined_steps // config.imagined_horizon),
            config.imagined_horizon,
            self.action_low,
            self.action_high,
        )
        observation, step = trajectories["observation"], trajectories["step"]
        with torch.no_grad():
            value = self.baseline(observation, step)
            done = trajectories["next", "done"]
            # No bootstrap at the imagined horizon: the baseline knows the time.
            advantage, target = vec_generalized_advantage_estimate(
                config.discount,
                config.gae_lambda,
                value,
                torch.cat([value[:, 1:], torch.zeros_like(value[:, :1])], dim=1),
                trajectories["next", "reward"],
                done=done,
                terminated=done,
            )
        valid = trajectories["valid"].squeeze(-1)
        samples = TensorDict(
            {
                "observation": observation[valid],
                "action": trajectories["action"][valid],
                "advantage": _standardize(advantage[valid]),
            },
            batch_size=[int(valid.sum())],
        )
        report = trpo_step(self.actor, samples, config.trpo)
        self.baseline.fit(observation[valid], step[valid], target[valid])
        rewards = trajectories["next", "reward"] * trajectories["valid"]
        return PolicyStep(
            report,
            imagined_return=rewards.sum(1).mean().item(),
            left_box=trajectories["next", "terminated"].any(1).float().mean().item(),
        )

    def imagined_starts(self, count: int) -> torch.Tensor:
        """First observations of imagined trajectories ``(count, n)``."""
        from_data = round(self.config.imagined_from_data * count)
        starts = [self.start_states(count - from_data)]
        if from_data:
            index = torch.randint(len(self.buffer), (from_data,))
            starts.append(self.buffer[index]["observation"])
        return torch.cat(starts).to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {
            "iteration": self.iteration,
            "dynamics": self.dynamics.state_dict(),
            "policy": self.policy.state_dict(),
            "baseline": self.baseline.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "buffer": self.buffer[:].to_dict() if len(self.buffer) else {},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.iteration = state["iteration"]
        self.dynamics.load_state_dict(state["dynamics"])
        self.policy.load_state_dict(state["policy"])
        self.baseline.load_state_dict(state["baseline"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.buffer.empty()
        if state["buffer"]:
            self.buffer.extend(TensorDict(state["buffer"]).auto_batch_size_(1))


def resolve_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one; a device that is not there is a ``ValueError``."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda was asked for, but torch finds no CUDA device; use cpu")
    return device


def _standardize(advantage: torch.Tensor) -> torch.Tensor:
    return (advantage - advantage.mean()) / (advantage.std() + 1e-8)


def _fit_metrics(fit: FitReport) -> dict[str, float]:
    return {
        "model/train_loss": fit.train_loss,
        "model/validation_loss": fit.validation_loss,
        "model/epochs": fit.epochs,
        "model/gradient_steps": fit.gradient_steps,
    }


def _policy_metrics(steps: list[PolicyStep]) -> dict[str, float]:
    reports = [step.report for step in steps]
    return {
        "imagined/return_first": steps[0].imagined_return,
        "imagined/return_last": steps[-1].imagined_return,
        "imagined/left_box": steps[-1].left_box,
        "trpo/kl": fmean(report.kl for report in reports),
        "trpo/improvement": fmean(report.improvement for report in reports),
        "trpo/accepted": fmean(report.accepted for report in reports),
    }
