"""A Minari dataset of a pendulum that is balanced, and a policy cloned from it.

    python minari_clone_data.py

Writes the dataset `pendulum/balanced-v0`, where Minari keeps its own, and `clone.pt`. Needs the
extra `minari` and `minari[create]`; half a minute.
"""

import gymnasium
import minari
import numpy as np
import torch

from torchrl_l1.dynamics import read_minari

DATASET = "pendulum/balanced-v0"


def record(episodes: int = 50, steps: int = 200) -> None:
    """Balance by a linear law with noise on the action, and let Minari's DataCollector look on."""
    gain, random = np.array([1.0, 10.0, 1.0, 2.0]), np.random.default_rng(0)
    env = minari.DataCollector(gymnasium.make("InvertedPendulum-v5", max_episode_steps=steps))
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        done = False
        while not done:
            noise = 0.3 * random.standard_normal()
            action = np.clip([gain @ observation + noise], -3, 3).astype(np.float32)
            observation, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
    env.create_dataset(DATASET, algorithm_name="linear law", eval_env="InvertedPendulum-v5")
    env.close()


def make_network() -> torch.nn.Module:
    """The policy, with random weights."""
    return torch.nn.Sequential(
        torch.nn.Linear(4, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1)
    ).double()


def clone(file: str = "clone.pt", epochs: int = 50) -> None:
    """Fit the policy to the recorded actions, and save its weights."""
    torch.manual_seed(0)
    data, network = read_minari(DATASET), make_network()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(epochs):
        for rows in data[torch.randperm(len(data))].split(256):
            loss = (network(rows["observation"]) - rows["action"]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    torch.save(network.state_dict(), file)


if __name__ == "__main__":
    record()
    clone()
