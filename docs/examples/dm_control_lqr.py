"""A linear-quadratic regulator on a task of dm_control; needs the extra `dm_control`."""

import numpy as np

import torchrl_l1


def regulator(x):
    return GAIN @ [x[0], np.arctan2(x[2], x[1]), x[3], x[4]]


GAIN = np.array([[0.89, 9.22, 1.5, 2.52]])
robust = torchrl_l1.robustify("dm_control/cartpole/balance", regulator, steps=3000)
print(robust.evaluate({"bias": 0.4}, episodes=3, most_steps=250))
