"""A PPO policy of Stable-Baselines3; needs the extra `sb3`."""

from stable_baselines3 import PPO

import torchrl_l1

policy = PPO.load("ppo.zip", device="cpu")
robust = torchrl_l1.robustify("gymnasium/InvertedPendulum-v5", policy)
print(robust.evaluate({"bias": [0.5, 1.0, 1.5]}))
