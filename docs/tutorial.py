"""The tutorial, in cells: `_tutorial.py` runs it when the documentation is built."""

# %% [markdown]
# This page is the script `docs/tutorial.py`, and everything it shows was computed when this
# documentation was built. It first trains a policy by PPO, without L1, as TorchRL's own examples
# do. Then it tests what a constant bias on the motor does to the policy, and puts L1 in between.
# The settings are small: all of it takes less than a minute on one core.
#
# ## A policy

# %%
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, GymEnv, SerialEnv, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import torchrl_l1
from torchrl_l1.envs import ActuatorBias

torch.manual_seed(0)


def make_env():
    return TransformedEnv(GymEnv("InvertedPendulum-v5"), DoubleToFloat())


network = torch.nn.Sequential(
    MLP(in_features=4, out_features=2, num_cells=[64, 64], activation_class=torch.nn.Tanh),
    NormalParamExtractor(),
)
actor = ProbabilisticActor(
    TensorDictModule(network, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    distribution_kwargs={"low": -3.0, "high": 3.0},
    return_log_prob=True,
)
value = MLP(in_features=4, out_features=1, num_cells=[64, 64], activation_class=torch.nn.Tanh)
critic = ValueOperator(value, in_keys=["observation"])

# %% [markdown]
# Proximal policy optimisation, on batches of 1600 steps from eight pendulums. The numbers printed
# are those of the policy with its exploration noise:

# %%
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
env = SerialEnv(8, make_env)
env.set_seed(0)
collector = Collector(
    env,
    actor,
    frames_per_batch=1600,
    total_frames=16_000,
    auto_register_policy_transforms=False,
)
for number, data in enumerate(collector):
    if number % 3 == 0:
        ended = data["next", "done"].sum()
        print(f"{(number + 1) * 1600:6d} steps: {1600 / max(1, ended):4.0f} to a fall")
    for _ in range(10):
        with torch.no_grad():
            advantage(data)
        for rows in data.reshape(-1)[torch.randperm(1600)].split(200):
            losses = loss(rows)
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"]).backward()
            optimizer.step()
collector.shutdown()

# %% [markdown]
# ## L1 around it
#
# {func}`~torchrl_l1.deployment.robustify` takes the actor as it is. It runs the actor with
# exploration noise in the undisturbed environment, fits an ensemble to the data, and calibrates the
# controller. The table shows what the model misses, for each entry of the observation (position,
# angle, and their rates).

# %%
robust = torchrl_l1.robustify("gymnasium/InvertedPendulum-v5", actor, steps=4000, progress=False)
print(robust.model.quality)

# %% [markdown]
# ## What it is worth
#
# The motor now has a bias that neither policy nor model has met. The controller is not told what
# it is; the oracle is.

# %%
table = robust.evaluate({"bias": [1.0, 1.5]}, episodes=5, most_steps=300, progress=False)
print(table)

# %%
chart = table.plot("tutorial.png")

# %% [markdown]
# ## In the loop
#
# `wrap` puts L1 into an environment. There `action` is what the policy chose, and `u_exec` is what
# L1 sent to the motor, to which the bias is added. Within a few steps the difference of the two is
# the bias with its sign reversed.

# %%
biased = TransformedEnv(GymEnv("InvertedPendulum-v5"), ActuatorBias(1.0))
data = robust.wrap(biased).rollout(100, robust.policy)
sent = (data["next", "l1", "u_exec"] - data["action"]).flatten()
print([round(value, 2) for value in sent[:100:10].tolist()])

# %% [markdown]
# `robust.save("folder")` keeps model, settings and calibration. [Robustify](robustify.md) says how
# to load them, make a film, or export a file for a machine without TorchRL.
