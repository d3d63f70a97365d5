"""A custom regularizer around a TorchRL loss: it penalizes action steps beyond a tolerance.

``python examples/own_regularizer.py`` takes seconds and learns nothing yet.
``python examples/own_regularizer.py 10000`` swings the pendulum up.
"""

from __future__ import annotations

import sys

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ExplorationType, GymEnv, set_exploration_type
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import LossModule, SACLoss, SoftUpdate

from torchrl_l2c2 import RegularizedLoss, action_variation, make_actor
from torchrl_l2c2.policy_distances import policy_mean

FRAMES = 200
FRAMES_PER_BATCH = 50


class ActionStepLoss(RegularizedLoss):
    """Half the squared excess of the mean action's step from s to s' over a tolerance."""

    def __init__(self, base_loss: LossModule, tolerance: float) -> None:
        self.step_tolerance = tolerance
        self.declare_networks(["actor_network"])
        self.declare_terms(policy=["loss_action_step"])

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        # Other states have one more dimension in front: [1, *B].
        later = tensordict["next"].select("observation").unsqueeze(0)
        policies = self.policies_at(tensordict, later)
        here, there = (policy_mean(policy, squashed=True) for policy in policies)
        excess = ((here - there).abs() - self.step_tolerance).clamp_min(0.0)
        cost = 0.5 * excess.square().sum(-1).mean(0)
        return terms.set("loss_action_step", self.reduce_term(cost, tensordict))


def main(frames: int) -> None:
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    actor = make_actor(3, env.action_spec, hidden=(64, 64))
    qvalue = ValueOperator(
        MLP(in_features=4, out_features=1, num_cells=[64, 64]), in_keys=["observation", "action"]
    )
    loss = SACLoss(actor, qvalue, target_entropy=-1.0)
    loss.make_value_estimator(gamma=0.95)
    loss = ActionStepLoss(loss, tolerance=0.05).fold()  # still a SACLoss
    updater = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=64)

    for collected in Collector(env, actor, frames_per_batch=FRAMES_PER_BATCH, total_frames=frames):
        replay.extend(collected)
        for _ in range(FRAMES_PER_BATCH):
            terms = loss(replay.sample())
            (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            updater.step()

    test_env = GymEnv("Pendulum-v1")
    test_env.set_seed(1)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        episode = test_env.rollout(200, actor)
    print(f"return {episode['next', 'reward'].sum().item():.1f}")
    print(f"action variation {action_variation(episode['action']).item():.3f}")
    print(f"penalty_action_step {terms['penalty_action_step'].item():.5f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES)
