"""PPO of a preset, by Stable-Baselines3: ``python -m benchmarks.zoo hopper_v5 --seeds 0 1``.

The same task, settings and test as of ``train.py preset=rl_zoo algorithm=ppo regularizer=none``
(or another ``--preset``), learned by the library that the settings are of: where the published
numbers are not reached here, this tells whether they are there.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks.timing import machine
from torchrl_l2c2 import action_variation
from torchrl_l2c2.experiment import ExperimentConfig
from torchrl_l2c2.experiment.cli.composition import CONF, check_preset, register
from torchrl_l2c2.experiment.envs.environments import TEST_SEED
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.experiment.settings.tasks import FIELD_TASKS
from torchrl_l2c2.metrics import spectral_smoothness

PEER = Path(__file__).with_name("zoo_peer.py")


def arguments(task: str, preset: str = "rl_zoo") -> dict[str, Any]:
    """Arguments of Stable-Baselines3's PPO, from the preset's own settings.

    Args:
        task (str): one of the preset's.
        preset (str): A folder of ``conf/preset``.

    Returns:
        dict: for ``benchmarks/zoo_peer.py``, without the seed.
    """
    register()
    chosen = [f"preset={preset}", f"task={task}", "algorithm=ppo", "regularizer=none"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        values: Any = OmegaConf.to_container(compose("config", chosen), resolve=True)
    check_preset(values, preset)
    config = ExperimentConfig.from_dict(values)
    ppo: Any = config.algorithm
    adam: Any = config.optimizer
    return {
        "env_id": config.task.env_id,
        "frames": config.task.frames,
        "num_envs": ppo.num_envs,
        "normalize": {"norm_obs": ppo.normalize_observations, "norm_reward": ppo.normalize_rewards},
        "linear": adam.linear,
        "test_episodes": config.test_episodes,
        "ppo": {
            "learning_rate": adam.lr,
            "n_steps": ppo.frames // ppo.num_envs,
            "batch_size": config.replay.batch_size,
            "n_epochs": ppo.epochs,
            "gamma": ppo.gamma,
            "gae_lambda": ppo.gae_lambda,
            "clip_range": ppo.clip_epsilon,
            "ent_coef": ppo.entropy_coeff,
            "vf_coef": ppo.critic_coeff,
            "max_grad_norm": ppo.max_grad_norm,
        },
        "policy": {
            "net_arch": {"pi": list(ppo.hidden), "vf": list(ppo.hidden)},
            "log_std_init": ppo.log_scale,
            "ortho_init": ppo.orthogonal,
            "activation_fn": {"relu": "ReLU", "tanh": "Tanh"}[ppo.activation],
        },
    }


def tested(given: dict[str, Any], python: str) -> tuple[float, float, float]:
    """Mean return, Sm and action variation of the test episodes of a policy that a peer trains."""
    command = [python, str(PEER), json.dumps(given)]
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    episodes = [torch.tensor(actions) for actions in found["actions"]]
    rough = torch.stack([spectral_smoothness(each, "asap") for each in episodes])
    varied = torch.stack([action_variation(each) for each in episodes])
    returns = torch.tensor(found["returns"])
    return returns.mean().item(), rough.mean().item(), varied.mean().item()


def main() -> None:
    """Prints a row for every seed as it ends; the training's returns go to standard error."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.zoo", description=__doc__)
    parser.add_argument("task", choices=list(FIELD_TASKS))
    parser.add_argument("--preset", choices=["rl_zoo", "baselines"], default="rl_zoo")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--frames", type=int, help="default: the preset's")
    parser.add_argument("--peer-python", default=sys.executable, help="has Stable-Baselines3")
    chosen = parser.parse_args()
    try:
        given = arguments(chosen.task, chosen.preset)
    except SettingError as error:
        parser.error(str(error))
    given["frames"] = chosen.frames or given["frames"]
    what = f"Stable-Baselines3's PPO on {given['env_id']}, preset={chosen.preset}"
    print(f"{what}, commit {machine()['commit']}\n")
    print("| seed | frames | return | Sm | action variation |\n| --- | --- | --- | --- | --- |")
    for seed in chosen.seeds:
        seeds = {"seed": seed, "test_seed": TEST_SEED + seed}
        total, rough, varied = tested({**given, **seeds}, chosen.peer_python)
        row = f"| {seed} | {given['frames']} | {total:.1f} | {rough:.3f} | {varied:.3f} |"
        print(row, flush=True)


if __name__ == "__main__":
    main()
