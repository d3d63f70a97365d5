"""A regularizer of one's own around a TorchRL loss: it charges action steps beyond a tolerance.

``python examples/own_regularizer.py`` trains DDPG on the pendulum for seconds with it, from random
actions alone; ``python examples/own_regularizer.py 10000`` for so many updates.
"""

from __future__ import annotations

import sys

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.modules import MLP, Actor, TanhModule, ValueOperator
from torchrl.objectives import DDPGLoss, LossModule, SoftUpdate

from torchrl_l2c2 import RegularizedLoss, action_variation

UPDATES = 300
RANDOM_FRAMES = 2000


class ActionStepLoss(RegularizedLoss):
    """Half the squared part of the action's change from s to s' that exceeds a tolerance."""

    _schedulable_buffers = frozenset({"step_coeff"})

    def __init__(self, base_loss: LossModule, tolerance: float, coeff: float = 1.0) -> None:
        self.step_tolerance = tolerance
        self._register_coefficient("step_coeff", coeff)
        self._regularize(["actor_network"])
        self.out_keys = [*self.out_keys, "loss_action_step"]

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        # States to compare with the batch's have one more dimension in front: [1, *B].
        later = tensordict["next"].select("observation").unsqueeze(0)
        here, there = self._policies_at(tensordict, later)
        excess = ((here - there).abs() - self.step_tolerance).clamp_min(0.0)
        cost = self._reduce_term(0.5 * excess.square().sum(-1).mean(0), tensordict)
        return terms.set("loss_action_step", self.step_coeff * cost)


def main(updates: int) -> None:
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    actor = TensorDictSequential(
        Actor(MLP(in_features=3, out_features=1, num_cells=[64, 64])),
        TanhModule(in_keys=["action"], spec=env.action_spec),
    )
    qvalue = ValueOperator(
        MLP(in_features=4, out_features=1, num_cells=[64, 64]), in_keys=["observation", "action"]
    )
    base = DDPGLoss(actor, qvalue, delay_actor=True, delay_value=True)
    base.make_value_estimator(gamma=0.95)
    loss = ActionStepLoss(base, tolerance=0.1, coeff=10.0)  # still a DDPGLoss
    updater = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(RANDOM_FRAMES), batch_size=64)
    replay.extend(env.rollout(RANDOM_FRAMES, break_when_any_done=False))

    for _ in range(updates):
        terms = loss(replay.sample())
        sum(term for key, term in terms.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()

    with torch.no_grad():
        episode = GymEnv("Pendulum-v1").rollout(200, actor)
    print(f"return {episode['next', 'reward'].sum().item():.1f}")
    print(f"action variation {action_variation(episode['action']).item():.3f}")
    print(f"loss_action_step {terms['loss_action_step'].item():.4f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else UPDATES)
