"""A policy cloned from a Minari dataset, both of `minari_clone_data.py`; extra `minari`."""

import torchrl_l1
from torchrl_l1.dynamics import read_minari

data = read_minari("pendulum/balanced-v0")
policy = "minari_clone_data.py:make_network"
robust = torchrl_l1.robustify(
    "gymnasium/InvertedPendulum-v5", policy, weights="clone.pt", data=data
)
print(robust.evaluate({"bias": [0.5, 1.0]}))
