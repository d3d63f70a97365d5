"""A process that trains and says how long it took: ``python benchmarks/peer.py NAME SETTINGS``.

Imports only the modules that the named library needs, and therefore runs in an environment of that
library's own. It trains once unmeasured, says ``ready``, and then trains for every line it is sent.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
# One thread for JAX as well.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
os.environ["JAX_PLATFORMS"] = "cpu"

Settings = dict[str, Any]
"""``env_id``, ``frames`` of an episode, ``turn`` frames of a turn, ``layers``, ``batch``,
``compile``."""


def sac_here(settings: Settings) -> Callable[[], object]:
    """This package's SAC: one update a frame, no regularizer, uniform replay."""
    from torchrl_l2c2.experiment import SACConfig, UniformReplayConfig

    algorithm = SACConfig(hidden=tuple(settings["layers"]), random_frames=0)
    replay = UniformReplayConfig(capacity=10_000, batch_size=settings["batch"])
    return _train_here(settings, algorithm, replay)


def td3_here(settings: Settings) -> Callable[[], object]:
    """This package's TD3: one update a frame, the policy in every other one, uniform replay."""
    from torchrl_l2c2.experiment import TD3Config, UniformReplayConfig

    algorithm = TD3Config(hidden=tuple(settings["layers"]), random_frames=0)
    replay = UniformReplayConfig(capacity=10_000, batch_size=settings["batch"])
    return _train_here(settings, algorithm, replay)


def paper_here(settings: Settings) -> Callable[[], object]:
    """The paper's algorithm with L2C2: one update a frame on average, prioritized replay."""
    from torchrl_l2c2.experiment import L2C2Config, PPORPEConfig, PrioritizedReplayConfig

    algorithm = PPORPEConfig(hidden=tuple(settings["layers"]), updates=settings["frames"])
    replay = PrioritizedReplayConfig(capacity=10_000, batch_size=settings["batch"])
    return _train_here(settings, algorithm, replay, L2C2Config())


def ppo_here(settings: Settings) -> Callable[[], object]:
    """This package's PPO: ten passes over every turn's frames, no regularizer."""
    from torchrl_l2c2.experiment import PPOConfig, RolloutReplayConfig

    algorithm = PPOConfig(hidden=tuple(settings["layers"]), frames=settings["turn"])
    return _train_here(settings, algorithm, RolloutReplayConfig(batch_size=settings["batch"]))


def _train_here(
    settings: Settings, algorithm: Any, replay: Any, regularizer: Any = None
) -> Callable[[], object]:
    from torchrl_l2c2.experiment import (
        Experiment,
        ExperimentConfig,
        NoRegularizerConfig,
        TaskConfig,
    )
    from torchrl_l2c2.experiment.run.process import keep_freed_memory

    keep_freed_memory()  # As train.py does.
    task = TaskConfig(
        "peer", settings["env_id"], max_steps=settings["frames"], episodes=1, noise_scale=0.0
    )
    experiment = Experiment(
        ExperimentConfig(
            task=task,
            algorithm=algorithm,
            replay=replay,
            regularizer=regularizer or NoRegularizerConfig(),
            compile=settings["compile"],
            late_share=0.0,  # The peers play no test episodes.
        )
    )

    def train() -> None:
        enough = experiment.player.frames + settings["turn"]
        while experiment.player.frames < enough:
            experiment.train(len(experiment.metrics) + 1)

    return train


def sac_sbx(settings: Settings) -> Callable[[], object]:
    """The SAC of SBX, Stable-Baselines3 in JAX."""
    from sbx import SAC

    return _learn(settings, SAC, _off_policy(settings))


def td3_sbx(settings: Settings) -> Callable[[], object]:
    """The TD3 of SBX."""
    from sbx import TD3

    return _learn(settings, TD3, _off_policy(settings))


def ppo_sbx(settings: Settings) -> Callable[[], object]:
    """The PPO of SBX."""
    from sbx import PPO

    return _learn(settings, PPO, {"n_steps": settings["turn"], "n_epochs": 10})


def sac_sb3(settings: Settings) -> Callable[[], object]:
    """The SAC of Stable-Baselines3."""
    import torch
    from stable_baselines3 import SAC

    torch.set_num_threads(1)
    return _learn(settings, SAC, {**_off_policy(settings), "device": "cpu"})


def ppo_sb3(settings: Settings) -> Callable[[], object]:
    """The PPO of Stable-Baselines3."""
    import torch
    from stable_baselines3 import PPO

    torch.set_num_threads(1)
    return _learn(settings, PPO, {"n_steps": settings["turn"], "n_epochs": 10, "device": "cpu"})


def _off_policy(settings: Settings) -> Settings:
    return {
        "buffer_size": 10_000,
        "learning_starts": settings["batch"],
        "train_freq": 1,
        "gradient_steps": 1,
    }


def _learn(settings: Settings, kind: Any, options: Settings) -> Callable[[], object]:
    import gymnasium

    model = kind(
        "MlpPolicy",
        gymnasium.make(settings["env_id"], max_episode_steps=settings["frames"]),
        policy_kwargs={"net_arch": list(settings["layers"])},
        batch_size=settings["batch"],
        **options,
    )
    return lambda: model.learn(settings["turn"], reset_num_timesteps=False, log_interval=None)


PEERS = {
    "sac": sac_here,
    "ppo": ppo_here,
    "td3": td3_here,
    "paper": paper_here,
    "sbx sac": sac_sbx,
    "sbx td3": td3_sbx,
    "sbx ppo": ppo_sbx,
    "sb3 sac": sac_sb3,
    "sb3 ppo": ppo_sb3,
}


def main(name: str, settings: str) -> None:
    """Answers every line with the seconds of a turn, by the clock and by the processor."""
    # What libraries print, also those in C, is no answer.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    try:
        train = PEERS[name](json.loads(settings))
    except ImportError as error:
        print(f"not measured: {error}", file=answers, flush=True)
        return
    train()
    print("ready", file=answers, flush=True)
    for _ in sys.stdin:
        started = time.perf_counter(), time.process_time()
        train()
        seconds = [time.perf_counter() - started[0], time.process_time() - started[1]]
        print(json.dumps(seconds), file=answers, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
