"""A SAC actor of TorchRL, whose weights `torchrl_sac_training.py` has saved."""

import torch
from torchrl_sac_training import make_actor

import torchrl_l1

actor = make_actor()
actor.load_state_dict(torch.load("sac.pt"))
robust = torchrl_l1.robustify("gymnasium/Pendulum-v1", actor)
print(robust.evaluate({"bias": [0.25, 0.5, 1.0]}))
