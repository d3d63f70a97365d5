"""PPO with L2C2 on several devices: each process plays its own episodes, gradients are averaged.

``torchrun --nproc-per-node=2 examples/several_devices.py`` takes seconds on the CPU and learns
nothing yet; append the number of frames, such as ``200000``. With GPUs each process uses one.
"""

from __future__ import annotations

import os
import sys

import torch
import torch.distributed as dist
from torch.nn.parallel import DistributedDataParallel
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, GymEnv, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_l2c2 import action_variation, make_actor, make_critic, smooth

FRAMES = 2000  # all processes together
FRAMES_PER_BATCH = 500  # per process
EPOCHS, PARTS = 5, 5


def main(frames: int) -> None:
    cuda = torch.cuda.is_available()
    dist.init_process_group("nccl" if cuda else "gloo")
    rank, size = dist.get_rank(), dist.get_world_size()
    device = torch.device(f"cuda:{os.environ['LOCAL_RANK']}" if cuda else "cpu")

    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1")
    env.set_seed(rank)
    actor = make_actor(3, env.action_spec, hidden=(64, 64)).to(device)
    critic = make_critic(3, num_heads=1, hidden=(64, 64)).to(device)
    # Each process normalizes its own advantages.
    loss = smooth(ClipPPOLoss(actor, critic, entropy_coeff=0.0, normalize_advantage=True))
    parallel = DistributedDataParallel(loss)
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    torch.manual_seed(rank)  # From here on each process draws its own numbers.
    collector = Collector(
        env, actor, frames_per_batch=FRAMES_PER_BATCH, total_frames=frames // size, device=device
    )
    for number, collected in enumerate(collector):
        loss.set_progress(number * FRAMES_PER_BATCH * size / frames)
        collected["next", "reward"] *= 0.1
        for _ in range(EPOCHS):
            with torch.no_grad():
                advantage(collected)
            for batch in collected[torch.randperm(FRAMES_PER_BATCH)].chunk(PARTS):
                terms = parallel(batch)
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()

    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        episode = env.rollout(200, actor)  # The collector has it on the device.
    mine = torch.cat([parameter.detach().flatten() for parameter in loss.parameters()])
    first = mine.clone()
    dist.broadcast(first, 0)
    # One string, as all processes write at once.
    told = f"process {rank} of {size}: return {episode['next', 'reward'].sum().item():.1f}"
    told += f", action variation {action_variation(episode['action']).item():.3f}"
    print(f"{told}, apart from the first {(mine - first).abs().max().item()}\n", end="", flush=True)
    dist.destroy_process_group()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES)
