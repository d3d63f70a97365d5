"""A process that trains Stable-Baselines3's PPO and plays test episodes: for ``benchmarks/zoo.py``.

Imports only that library's own needs, and therefore runs in an environment of its own. It prints
the episodes' returns and clipped mean actions as JSON, and while it learns, the training's returns
to standard error.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"


def train(given: dict[str, Any]) -> Any:
    """A model, with its normalization, after its frames."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)
    env = make_vec_env(given["env_id"], given["num_envs"], seed=given["seed"])
    if any(given["normalize"].values()):
        env = VecNormalize(env, gamma=given["ppo"]["gamma"], **given["normalize"])
    rate = given["ppo"]["learning_rate"]
    if given["linear"]:
        given["ppo"]["learning_rate"] = lambda left: left * rate
    activation = getattr(torch.nn, given["policy"]["activation_fn"])
    policy = {**given["policy"], "activation_fn": activation}
    model = PPO(
        "MlpPolicy", env, policy_kwargs=policy, seed=given["seed"], device="cpu", **given["ppo"]
    )
    told = 0

    def tell(*_: object) -> bool:
        nonlocal told
        frames = model.num_timesteps
        if (done := 10 * frames // given["frames"]) > told and model.ep_info_buffer:
            told, returns = done, [episode["r"] for episode in model.ep_info_buffer]
            mean = sum(returns) / len(returns)
            print(f"frame {frames}: return {mean:.1f}", file=sys.stderr, flush=True)
        return True  # the training continues

    model.learn(given["frames"], callback=tell)
    return model


def play(model: Any, given: dict[str, Any]) -> dict[str, list[Any]]:
    """Test episodes with the mean action."""
    import gymnasium
    import numpy as np

    env = gymnasium.make(given["env_id"])
    assert isinstance(env.action_space, gymnasium.spaces.Box)
    low, high = env.action_space.low, env.action_space.high
    normalization = model.get_vec_normalize_env()
    played: dict[str, list[Any]] = {"returns": [], "actions": []}
    observation, _ = env.reset(seed=given["test_seed"])
    for _ in range(given["test_episodes"]):
        total, actions, ended = 0.0, [], False
        while not ended:
            seen = normalization.normalize_obs(observation) if normalization else observation
            mean, _ = model.predict(seen, deterministic=True)
            actions.append(np.clip(mean, low, high).tolist())
            observation, reward, terminated, truncated, _ = env.step(np.array(actions[-1]))
            total, ended = total + float(reward), terminated or truncated
        played["returns"].append(total)
        played["actions"].append(actions)
        observation, _ = env.reset()
    return played


if __name__ == "__main__":
    settings = json.loads(sys.argv[1])
    print(json.dumps(play(train(settings), settings)))
