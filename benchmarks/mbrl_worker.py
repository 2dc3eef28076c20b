"""mbrl-lib's side of the comparisons: a command per line in, an answer per line out.

Runs in the peers' environment and imports nothing of this project.
"""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace
from typing import Any

import gymnasium
import mbrl.models
import mbrl.planning
import numpy as np
import omegaconf
import torch
from mbrl.types import TransitionBatch
from mbrl.util.replay_buffer import BootstrapIterator, TransitionIterator
from torch import Tensor

_OPTIMIZER = "mbrl.planning.CEMOptimizer"


class Worker:
    """One model, an agent that plans with it, and trainers. Each method answers one command."""

    def __init__(self) -> None:
        self.trainers: dict[str, tuple[Any, ...]] = {}

    def start(self, threads: int) -> dict[str, str]:
        """Set the number of threads."""
        torch.set_num_threads(threads)
        return {"torch": torch.__version__}

    def model(self, path: str) -> None:
        """Build the model that a file describes, weights included."""
        given = torch.load(path)
        weights = given["weights"]
        self.network = mbrl.models.GaussianMLP(
            weights[0].shape[1],
            weights[-1].shape[2] // 2,
            "cpu",
            num_layers=len(weights) - 1,
            ensemble_size=weights[0].shape[0],
            hid_size=weights[0].shape[2],
            propagation_method="fixed_model",
            learn_logvar_bounds=True,
            activation_fn_cfg={"_target_": "torch.nn.SiLU"},
        )
        layers = [part[0] for part in self.network.hidden_layers] + [self.network.mean_and_logvar]
        with torch.no_grad():
            for layer, weight, bias in zip(layers, weights, given["biases"], strict=True):
                layer.weight.copy_(weight)
                layer.bias.copy_(bias)
            self.network.min_logvar.copy_(given["min_logvar"])
            self.network.max_logvar.copy_(given["max_logvar"])
        self.wrapped = mbrl.models.OneDTransitionRewardModel(
            self.network, target_is_delta=True, normalize=True, learned_rewards=False
        )
        self.wrapped.input_normalizer.mean = given["input_mean"]
        self.wrapped.input_normalizer.std = given["input_std"]

    def agent(
        self,
        horizon: int,
        candidates: int,
        elites: int,
        iterations: int,
        particles: int,
        column: int,
        cost: float,
    ) -> None:
        """Build the agent. The reward is a column of the next state less the actions' cost."""
        inputs, outputs = self.network.in_size, self.network.out_size
        spaces = SimpleNamespace(
            observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (outputs,)),
            action_space=gymnasium.spaces.Box(-1.0, 1.0, (inputs - outputs,)),
        )

        def reward(action: Tensor, successor: Tensor) -> Tensor:
            return (successor[:, column] - cost * action.square().sum(-1))[:, None]

        def terminated(action: Tensor, successor: Tensor) -> Tensor:
            return torch.zeros(successor.shape[0], 1, dtype=torch.bool)

        self.env = mbrl.models.ModelEnv(spaces, self.wrapped, terminated, reward)
        self.particles = particles
        settings = {
            "_target_": _OPTIMIZER,
            "num_iterations": iterations,
            "elite_ratio": elites / candidates,
            "population_size": candidates,
            "alpha": 0.1,
            "device": "cpu",
            "return_mean_elites": True,
            "clipped_normal": False,
        }
        bound = np.ones(inputs - outputs)
        self.planner = mbrl.planning.TrajectoryOptimizerAgent(
            omegaconf.OmegaConf.create(settings), -bound, bound, planning_horizon=horizon
        )
        self.planner.set_trajectory_eval_fn(self._returns)

    def plan(self, observation: list[float]) -> None:
        """One plan, from scratch."""
        self.planner.reset()
        self.planner.plan(np.array(observation, dtype=np.float32))

    def returns(self, observation: list[float], actions: list[Any]) -> list[float]:
        """Returns of action sequences."""
        found = self._returns(np.array(observation, dtype=np.float32), torch.tensor(actions))
        return found.tolist()

    def _returns(self, observation: Any, actions: Tensor) -> Tensor:
        return self.env.evaluate_action_sequences(
            actions, initial_state=observation, num_particles=self.particles
        )

    def data(
        self, name: str, path: str, batch_size: int, learning_rate: float, weight_decay: float
    ) -> None:
        """Load transitions to train and to validate on, and build a trainer of the model."""
        given = torch.load(path)
        sets = []
        for part in ("train", "validation"):
            observation, action, successor = (column.numpy() for column in given[part])
            none = np.zeros(len(observation), dtype=np.float32)
            flags = np.zeros(len(observation), dtype=bool)
            sets.append(TransitionBatch(observation, action, successor, none, flags, flags))
        trainer = mbrl.models.ModelTrainer(
            self.wrapped, optim_lr=learning_rate, weight_decay=weight_decay
        )
        self.trainers[name] = trainer, batch_size, *sets

    def fit(self, name: str, epochs: int) -> None:
        """Train for some epochs, on iterators as mbrl-lib's own examples make them."""
        trainer, batch_size, train, validation = self.trainers[name]
        batches = BootstrapIterator(train, batch_size, len(trainer.model), shuffle_each_epoch=True)
        held_out = TransitionIterator(validation, batch_size)
        trainer.train(batches, held_out, num_epochs=epochs, silent=True)


def main() -> None:
    """Answer until the input ends."""
    answers, sys.stdout = sys.stdout, sys.stderr
    worker = Worker()
    for line in sys.stdin:
        arguments = json.loads(line)
        answer = getattr(worker, arguments.pop("command"))(**arguments)
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
