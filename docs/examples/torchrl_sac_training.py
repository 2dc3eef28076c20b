"""SAC of TorchRL on Gymnasium's pendulum: writes the state dict of the actor to `sac.pt`.

    python torchrl_sac_training.py

Two to three minutes on one core.
"""

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate


def make_actor() -> ProbabilisticActor:
    """The actor, with random weights."""
    network = torch.nn.Sequential(
        MLP(in_features=3, out_features=2, num_cells=[64, 64]), NormalParamExtractor()
    )
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0},
    )


def train(
    file: str = "sac.pt", steps: int = 12_000, random_steps: int = 1000, seed: int = 0
) -> None:
    """Train an actor and save its weights."""
    torch.manual_seed(seed)
    env = GymEnv("Pendulum-v1")
    env.set_seed(seed)
    actor = make_actor()
    value = MLP(in_features=4, out_features=1, num_cells=[64, 64])
    critic = ValueOperator(value, in_keys=["observation", "action"])
    loss = SACLoss(actor, critic, action_spec=env.action_spec)
    loss.make_value_estimator(gamma=0.98)
    target = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(steps), batch_size=128)
    collector = Collector(
        env,
        actor,
        frames_per_batch=100,
        total_frames=steps,
        init_random_frames=random_steps,
        auto_register_policy_transforms=False,
    )
    for data in collector:
        buffer.extend(data)
        for _ in range(100 if len(buffer) > random_steps else 0):
            losses = loss(buffer.sample())
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
            optimizer.step()
            target.step()
    collector.shutdown()
    torch.save(actor.state_dict(), file)


if __name__ == "__main__":
    train()
