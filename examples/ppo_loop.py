"""PPO with generalized advantages and L2C2 in a plain loop, on the pendulum.

``python examples/ppo_loop.py`` shows in seconds that it runs;
``python examples/ppo_loop.py 200000`` swings the pendulum up, and with ``plain`` behind it does so
without L2C2.
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

from torchrl_l2c2 import L2C2Loss, Neighborhood, action_variation, make_actor, make_critic
from torchrl_l2c2.gains import RampGain

FRAMES = 2000
FRAMES_PER_BATCH = 1000
EPOCHS = 5
REWARD_SCALE = 0.1


def main(frames: int, plain: bool = False) -> None:
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    actor = make_actor(3, env.action_spec, hidden=(64, 64))
    critic = make_critic(3, num_heads=1, hidden=(64, 64))

    near = Neighborhood(lambda_min=1.0, lambda_max=100.0, shared=True)
    base = ClipPPOLoss(actor, critic, entropy_coeff=0.0, normalize_advantage=True)
    # On policy the loss draws the neighbors: the batch is not replayed.
    loss = base if plain else L2C2Loss(base, near, beta=0.0, policy_distance="mse")
    ramp = RampGain()  # from 0 to 1 over the training
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    minibatches = TensorDictReplayBuffer(
        storage=LazyTensorStorage(FRAMES_PER_BATCH),
        sampler=SamplerWithoutReplacement(),
        batch_size=100,
    )
    collector = Collector(env, actor, frames_per_batch=FRAMES_PER_BATCH, total_frames=frames)

    for number, collected in enumerate(collector):
        if not plain:
            loss.l2c2_coeff = ramp.step(number * FRAMES_PER_BATCH / frames)
        collected["next", "reward"] *= REWARD_SCALE
        for _ in range(EPOCHS):
            with torch.no_grad():
                advantage(collected)
            minibatches.extend(collected.reshape(-1))
            for batch in minibatches:
                terms = loss(batch)
                sum(term for key, term in terms.items() if key.startswith("loss")).backward()
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
    main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES, "plain" in sys.argv)
