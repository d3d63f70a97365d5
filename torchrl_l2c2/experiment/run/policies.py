"""A run's policy: written to the run's folder, and read back from it."""

from __future__ import annotations

import importlib.util
import io
import math
import sys
from dataclasses import replace
from pathlib import Path

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from torchrl_l2c2.experiment.agents.build import make_agent
from torchrl_l2c2.experiment.envs.environments import TEST_SEED, make_env, time_limit
from torchrl_l2c2.experiment.envs.pictures import Drawing
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.checkpoints import CheckpointError, load_newest
from torchrl_l2c2.experiment.run.files import REMEDY, read_config, write_atomically
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import SettingError


def load_policy(
    folder: str | Path,
    *,
    seed: int | None = None,
    noise_scale: float | None = None,
    best: bool = False,
    render: Drawing | None = None,
) -> tuple[TensorDictModule, EnvBase, int]:
    """Loads a run's acting policy and makes an environment of its task.

    The policy is a TorchRL actor: it reads ``"observation"`` and writes ``"action"``, the mean
    under ``set_exploration_type(ExplorationType.DETERMINISTIC)`` and a sample otherwise. Torch's
    global generator is left as it was.

    Args:
        folder (str or Path): The run's folder, finished or not.

    Keyword Args:
        seed (int, optional): Seed of the environment and its noise. Default: the test's seed.
        noise_scale (float, optional): Scale of the environment's noise; larger values are harder.
            Default: the task's.
        best (bool): whether to take the best policy of the tests during training, where
            ``evaluate_every`` had some, instead of the last. Default ``False``.
        render (Drawing, optional): which states the simulator draws, as for
            :func:`~.environments.make_env`. Default: none.

    Returns:
        The policy, the environment and the longest episode.

    Raises:
        FileNotFoundError: the folder is not a run's, or holds no such policy nor a checkpoint.
        CheckpointError: its policy, or all of its checkpoints, are damaged.
        ValueError: its ``config.json`` is damaged, or names a task module inside the folder
            itself, which would execute code of whoever trained the policy.
        SettingError: a scale of noise that is negative or not finite, or a seed that NumPy does
            not take.

    Examples:
        >>> import tempfile
        >>> from torchrl_l2c2.experiment import Experiment, ExperimentConfig, TaskConfig
        >>> task = TaskConfig("pendulum", "Pendulum-v1", episodes=1, max_steps=20)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     experiment = Experiment(ExperimentConfig(task=task, compile=False), folder)
        ...     _ = experiment.train()
        ...     policy, env, max_steps = load_policy(folder, seed=1)
        ...     experiment.close()
        >>> env.rollout(max_steps, policy)["action"].shape
        torch.Size([20, 1])
    """
    folder, seed = Path(folder), seed_of_test(folder, seed)
    if noise_scale is not None and not 0 <= noise_scale < math.inf:
        raise SettingError("noise_scale", f"must be at least 0 and finite, got {noise_scale}.")
    config = ExperimentConfig.from_dict(read_config(folder))
    config = replace(config, device="cpu")
    _check_origin(config.task.env_id, folder)
    noise = config.task.noise_scale if noise_scale is None else noise_scale
    task = replace(config.task.for_test(), noise_scale=noise)
    with torch.random.fork_rng(devices=[]):  # Weights are drawn, before they are read.
        env = make_env(task, seed, render=render)
        agent = make_agent(config, env)
    saved = folder / ("policy_best.pt" if best else "policy.pt")
    if saved.exists():
        _load_weights(agent.policy, saved)
    elif best:
        raise FileNotFoundError(
            f"{str(saved)!r} does not exist; evaluate_every=N makes it "
            "while a run is trained: of one that has ended, train it in another folder."
        )
    elif newest := load_newest(folder):
        agent.load_networks(newest[1])
    else:
        raise FileNotFoundError(f"{str(folder)!r} holds neither policy.pt nor a checkpoint yet.")
    return agent.policy, env, time_limit(config.task)


def seed_of_test(folder: str | Path, seed: int | None = None) -> int:
    """Returns the seed of a run's test, or checks another seed.

    Args:
        folder (str or Path): The run's folder.
        seed (int, optional): Another seed.

    Raises:
        FileNotFoundError: the folder is not a run's.
        ValueError: its ``config.json`` is damaged.
        SettingError: a seed that NumPy does not take.
    """
    if seed is not None and not 0 <= seed < 2**32:
        raise SettingError("seed", f"must be at least 0 and below 2 ** 32, got {seed}.")
    if not (Path(folder) / "config.json").exists():
        raise FileNotFoundError(f"{str(folder)!r} is not the folder of a run: no config.json.")
    return int(read_config(folder)["seed"]) + TEST_SEED if seed is None else seed


def _check_origin(env_id: str, folder: Path) -> None:
    """Refuses a task whose module is in the run's folder, or in a package around it.

    A run's settings may come from somebody else, and an import executes code. Modules that are
    already imported, such as a script's own task, are accepted.
    """
    module = env_id.rpartition(":")[0]
    name = "" if module in sys.modules else module.partition(".")[0]
    # Of what is not within another no finder imports anything.
    spec = importlib.util.find_spec(name) if name else None
    places = spec and (spec.submodule_search_locations or filter(None, [spec.origin]))
    run = folder.resolve()
    for place in [Path(place).resolve() for place in places or ()]:
        if place in (run, *run.parents) or run in place.parents:
            raise UserError(
                f"{folder / 'config.json'}: task.env_id={env_id!r} would execute {place}, which is "
                "no module of yours but comes with the run. If you trust it, install it or "
                "move it to your own code."
            )


def _load_weights(policy: TensorDictModule, path: Path) -> None:
    try:
        policy.load_state_dict(torch.load(path, "cpu", weights_only=True))
    except OSError:
        raise
    # With damaged bytes torch raises errors of many kinds, on many lines.
    except Exception as error:
        what = f"{path} does not hold this run's policy ({type(error).__name__})"
        raise CheckpointError(f"{what}: {REMEDY}") from error


def save_policy(policy: torch.nn.Module, path: str | Path) -> None:
    """Writes the policy's ``state_dict``; read it with ``torch.load(path, weights_only=True)``."""
    content = io.BytesIO()
    torch.save({k: v.detach().clone() for k, v in policy.state_dict().items()}, content)
    write_atomically(path, content.getvalue())
