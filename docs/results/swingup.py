"""dm_control's cartpole, to be swung up, with an action every 0.05 s.

    torchrl-l1 run pets/any task=docs/results/swingup.py:make_env reward=learned termination=none

An episode is 10 s, as it is in the suite, and returns as much: the rewards of the steps in between
are summed up, so that 1000 is the best. Needs the extra `dm_control`.
"""

from __future__ import annotations

from torchrl.envs import DMControlEnv, EnvBase, TransformedEnv
from torchrl.envs.transforms import CatTensors, Compose, DoubleToFloat, FrameSkipTransform

REPEAT = 5


def make_env() -> EnvBase:
    """The environment."""
    keys = ["position", "velocity"]
    return TransformedEnv(
        DMControlEnv("cartpole", "swingup"),
        Compose(
            FrameSkipTransform(REPEAT),
            CatTensors(keys, "observation"),
            DoubleToFloat(in_keys=["observation", "reward"]),
        ),
    )
