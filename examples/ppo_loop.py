"""PPO with L2C2 in a TorchRL loop, on the pendulum.

``python examples/ppo_loop.py`` takes seconds and learns nothing yet. ``python examples/ppo_loop.py
200000`` swings the pendulum up; add ``baseline`` to train without L2C2.
"""

from __future__ import annotations

import sys

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import ExplorationType, GymEnv, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_l2c2 import action_variation, make_actor, make_critic, smooth

FRAMES = 2000
FRAMES_PER_BATCH = 1000
EPOCHS = 5
REWARD_SCALE = 0.1


def main(frames: int, baseline: bool = False) -> None:
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    actor = make_actor(3, env.action_spec, hidden=(64, 64))
    critic = make_critic(3, num_heads=1, hidden=(64, 64))

    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, normalize_advantage=True)
    if not baseline:
        loss = smooth(loss)
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    minibatches = TensorDictReplayBuffer(
        storage=LazyTensorStorage(FRAMES_PER_BATCH),
        sampler=SamplerWithoutReplacement(),
        batch_size=100,
    )
    collector = Collector(env, actor, frames_per_batch=FRAMES_PER_BATCH, total_frames=frames)

    for number, collected in enumerate(collector):
        if not baseline:
            loss.set_progress(number * FRAMES_PER_BATCH / frames)
        collected["next", "reward"] *= REWARD_SCALE
        for _ in range(EPOCHS):
            with torch.no_grad():
                advantage(collected)
            minibatches.extend(collected.reshape(-1))
            for batch in minibatches:
                terms = loss(batch)
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()

    test_env = GymEnv("Pendulum-v1")
    test_env.set_seed(1)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        episode = test_env.rollout(200, actor)
    print(f"return {episode['next', 'reward'].sum().item():.1f}")
    print(f"action variation {action_variation(episode['action']).item():.3f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES, "baseline" in sys.argv)
