"""An exported policy in its simulator, with ONNX Runtime, Gymnasium and NumPy only.

``python -m torchrl_l2c2 export RUN`` writes the folder; ``python examples/onnx_policy.py
RUN/export 10`` plays ten episodes with it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
from gymnasium import spaces


def observed(space: spaces.Space[Any], seen: Any, contract: dict[str, Any]) -> Any:
    """The policy's input: a vector, with the entries of a dict in the order of their names."""
    if isinstance(space, spaces.Dict):
        names = sorted(space.spaces)
        return np.concatenate([spaces.flatten(space[name], seen[name]) for name in names])
    return spaces.flatten(space, seen)


def play(folder: Path, episodes: int) -> None:
    """Prints the mean return and the mean change of the action from step to step."""
    contract = json.loads((folder / "contract.json").read_text())
    session = onnxruntime.InferenceSession(folder / "policy.onnx")
    env = gymnasium.make(contract["task"], max_episode_steps=contract["longest_episode"])
    noise = np.random.default_rng(0)
    returns, changes = [], []
    for episode in range(episodes):
        seen, _ = env.reset(seed=episode)
        rewards, actions, over = [], [], False
        while not over:
            seen = observed(env.observation_space, seen, contract["observation"])
            # As in training: float32, with the task's noise.
            seen = seen + contract["noise_scale"] * noise.standard_normal(seen.shape)
            batch = seen.astype(np.float32)[None]
            (action,) = session.run(["action"], {"observation": batch})[0]
            seen, reward, terminated, truncated, _ = env.step(action)
            rewards.append(float(reward))
            actions.append(action)
            over = terminated or truncated
        returns.append(sum(rewards))
        changes.append(np.linalg.norm(np.diff(actions, axis=0), axis=-1).mean())
    env.close()
    print(f"return {np.mean(returns):.1f}")
    print(f"action variation {np.mean(changes):.3f}")
    # Other seeds: the two returns differ by chance.
    if "test" in contract:
        print(f"return in the run's own test {contract['test']['return_mean']:.1f}")


if __name__ == "__main__":
    if len(sys.argv) < 2 or not Path(sys.argv[1], "contract.json").exists():
        sys.exit("Usage: python examples/onnx_policy.py RUN/export [EPISODES]")
    sys.path.insert(0, "")  # A task of your own may be in a module of this folder.
    play(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
