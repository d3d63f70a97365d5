"""PPO with L2C2 on Brax's Ant, simulated by JAX next to TorchRL's networks.

``python examples/brax_ant.py`` shows in two minutes that it runs on a CPU; JAX compiles most of the
time. On a GPU: ``python examples/brax_ant.py --device cuda --envs 4096 --iterations 500``; add
``--baseline`` to train without L2C2. Needs ``pip install brax jax`` (``jax[cuda13]`` on a GPU).
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDict
from torchrl.envs import BraxEnv, Compose, RewardScaling, StepCounter, TransformedEnv, VecNormV2
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR
from torchrl.objectives.value import GAE

from torchrl_l2c2 import make_actor, make_critic, smooth

LAYERS, EPOCHS, MINIBATCHES = (256, 128, 64), 5, 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="ant", help="name of a Brax environment")
    parser.add_argument("--envs", type=int, default=8, help="number of environments")
    parser.add_argument("--steps", type=int, default=24, help="steps of each in an iteration")
    parser.add_argument("--iterations", type=int, default=2)
    parser.add_argument("--baseline", action="store_true", help="train without L2C2")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    torch.manual_seed(options.seed)
    # Clearing JAX's cache, which is on by default, would compile the simulation again.
    sim = {"device": options.device, "cache_clear_frequency": False}
    normalize = VecNormV2(in_keys=["observation"], reduce_batch_dims=True)
    transforms = Compose(normalize, RewardScaling(loc=0.0, scale=0.1), StepCounter(1000))
    env = TransformedEnv(BraxEnv(options.env, batch_size=[options.envs], **sim), transforms)
    env.set_seed(options.seed)
    state = env.reset()
    size = state["observation"].shape[-1]
    actor = make_actor(size, env.action_spec_unbatched, hidden=LAYERS).to(options.device)
    critic = make_critic(size, num_heads=1, hidden=LAYERS).to(options.device)

    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, normalize_advantage=True)
    if not options.baseline:
        loss = smooth(loss)
    advantage = GAE(gamma=0.97, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    scheduler = KLAdaptiveLR(optimizer, target_kl=0.01)  # the learning rate follows the KL

    for iteration in range(options.iterations):
        if not options.baseline:
            loss.set_progress(iteration / options.iterations)
        steps = []
        with torch.no_grad():
            for _ in range(options.steps):
                step, state = env.step_and_maybe_reset(actor(state))
                steps.append(step.exclude("state", ("next", "state")))  # JAX's own, which is large
            rollout = TensorDict.stack(steps, 1)
            advantage(rollout)
        rows = rollout.reshape(-1)
        for _ in range(EPOCHS):
            for chosen in torch.randperm(len(rows), device=options.device).chunk(MINIBATCHES):
                terms = loss(rows[chosen])
                optimizer.zero_grad()
                sum(term for key, term in terms.items() if key.startswith("loss")).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
        with torch.no_grad():
            scheduler.step(loss(rows)["kl_approx"])
        change = rollout["loc"].diff(dim=1).norm(dim=-1)[~rollout["next", "done"][:, :-1, 0]]
        reward = 10 * rollout["next", "reward"].mean()
        print(f"{iteration + 1}: reward {reward:.3f}, action variation {change.mean():.3f}")


if __name__ == "__main__":
    main()
