"""L2C2 inside TorchRL's own SAC trainer, on the pendulum.

``python examples/torchrl_trainer.py`` takes seconds and learns nothing yet.
``python examples/torchrl_trainer.py 10000`` swings the pendulum up.
"""

from __future__ import annotations

import sys

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer
from torchrl.envs import ExplorationType, GymEnv, set_exploration_type
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss
from torchrl.trainers.algorithms import SACTrainer

from torchrl_l2c2 import ProgressHook, TSoftUpdate, action_variation, make_actor, smooth

FRAMES = 200
FRAMES_PER_BATCH = 50


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
    loss = smooth(loss)
    replay = TensorDictPrioritizedReplayBuffer(
        alpha=0.6,
        beta=0.5,
        storage=LazyTensorStorage(100_000),
        batch_size=64,
        transform=loss.neighbor_transform(),  # optional: draws neighbors where batches are drawn
    )
    trainer = SACTrainer(
        collector=Collector(env, actor, frames_per_batch=FRAMES_PER_BATCH, total_frames=frames),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=FRAMES_PER_BATCH,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        target_net_updater=TSoftUpdate(loss, tau=0.005),
        replay_buffer=replay,
        enable_logging=False,
        progress_bar=False,
    )
    ProgressHook().register(trainer)  # the penalty grows from 0
    trainer.train()

    test_env = GymEnv("Pendulum-v1")
    test_env.set_seed(1)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        episode = test_env.rollout(200, actor)
    print(f"return {episode['next', 'reward'].sum().item():.1f}")
    print(f"action variation {action_variation(episode['action']).item():.3f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES)
