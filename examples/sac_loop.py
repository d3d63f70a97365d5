"""SAC with L2C2 in a TorchRL loop, on the pendulum.

``python examples/sac_loop.py`` takes seconds and learns nothing yet. ``python examples/sac_loop.py
10000`` swings the pendulum up; add ``baseline`` to train without L2C2.
"""

from __future__ import annotations

import sys

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer
from torchrl.envs import ExplorationType, GymEnv, set_exploration_type
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_l2c2 import action_variation, make_actor, smooth

FRAMES = 300
FRAMES_PER_BATCH = 50
RANDOM_FRAMES = 200
UPDATES_PER_BATCH = 50


def main(frames: int, baseline: bool = False) -> None:
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    actor = make_actor(3, env.action_spec, hidden=(64, 64))
    qvalue = ValueOperator(
        MLP(in_features=4, out_features=1, num_cells=[64, 64]), in_keys=["observation", "action"]
    )

    loss = SACLoss(actor, qvalue, target_entropy=-1.0)
    loss.make_value_estimator(gamma=0.95)
    if not baseline:
        loss = smooth(loss)
    updater = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictPrioritizedReplayBuffer(
        alpha=0.6,
        beta=0.5,
        storage=LazyTensorStorage(100_000),
        batch_size=64,
    )
    collector = Collector(
        env,
        actor,
        frames_per_batch=FRAMES_PER_BATCH,
        total_frames=frames,
        init_random_frames=RANDOM_FRAMES,
    )

    for number, collected in enumerate(collector):
        if not baseline:
            loss.set_progress(number * FRAMES_PER_BATCH / frames)
        replay.extend(collected)
        if len(replay) < RANDOM_FRAMES:
            continue
        for _ in range(UPDATES_PER_BATCH):
            batch = replay.sample()
            terms = loss(batch)
            (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            updater.step()
            replay.update_tensordict_priority(batch)

    test_env = GymEnv("Pendulum-v1")
    test_env.set_seed(1)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        episode = test_env.rollout(200, actor)
    print(f"return {episode['next', 'reward'].sum().item():.1f}")
    print(f"action variation {action_variation(episode['action']).item():.3f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES, "baseline" in sys.argv)
