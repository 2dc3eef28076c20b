"""The real environments of MBMF's stages, with what acts in them."""

from __future__ import annotations

from functools import partial

from torchrl_l1.algorithms.collection import Collection
from torchrl_l1.algorithms.fine_tuning import exploring
from torchrl_l1.algorithms.mbmf_config import MBMFConfig
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import Perturbation, Task
from torchrl_l1.planning import ModelPredictiveController


class StageEnvironments:
    """What collects and what measures in each stage; L1 is around the planner alone.

    Args:
        task: what is learned.
        config: settings of the algorithm.
        dynamics: the model that L1 uses.
        planner: acts in the first stage.
        visiting: the policy whose states the planner labels in the second.
        clone: what the second stage learns.
        policy: what the third stage improves.
        l1: the adaptive controller; ``None`` for none.
        perturbation: noise and disturbances, in all stages.
        horizon: steps per full episode; the task's own if ``None``.
        compile_l1: whether to compile the controller's step.

    Attributes:
        start: random data.
        shooting: episodes of the planner that join the data.
        shooting_measured: full ones beside them.
        visits: episodes of the policy whose states are labelled.
        clone_measured: full episodes of the clone.
        practice: episodes that PPO learns from.
        policy_measured: full ones beside them.
    """

    def __init__(
        self,
        task: Task,
        config: MBMFConfig,
        dynamics: EnsembleDynamics,
        *,
        planner: ModelPredictiveController,
        visiting: GaussianPolicy,
        clone: GaussianPolicy,
        policy: GaussianPolicy,
        l1: L1Config | None,
        perturbation: Perturbation,
        horizon: int | None,
        compile_l1: CompileMode,
    ) -> None:
        full = horizon or task.horizon
        steps = min(config.episode_steps or full, full)
        real = partial(Collection, task, dynamics=dynamics, perturbation=perturbation)
        planned = partial(real, policy=planner, l1=l1, compile_l1=compile_l1)
        measured = partial(real, episodes=config.evaluation_episodes, horizon=full, l1=None)
        explorer = exploring(policy, task)

        self.start = planned(
            episodes=config.random_episodes, horizon=min(config.random_steps or steps, full)
        )
        self.shooting = planned(episodes=config.shooting_episodes, horizon=steps)
        self.shooting_measured = planned(episodes=config.shooting_episodes, horizon=full)
        self.visits = real(
            policy=acting(visiting, task), episodes=config.cloning.episodes, horizon=steps, l1=None
        )
        self.clone_measured = measured(policy=acting(clone, task))
        self.practice = real(
            policy=explorer, episodes=config.fine_tuning.episodes, horizon=steps, l1=None
        )
        self.policy_measured = measured(policy=explorer)
