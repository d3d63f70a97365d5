"""Saving and loading of policies."""

from __future__ import annotations

import importlib.util
import io
import json
import math
import sys
import warnings
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
    """Loads a run's acting policy and creates an environment of its task.

    The policy is a TorchRL actor that reads ``"observation"`` and writes ``"action"``: the mean
    action under ``set_exploration_type(ExplorationType.DETERMINISTIC)``, otherwise a sample.
    Torch's global random generator does not change.

    Args:
        folder (str or Path): Run folder, finished or not.

    Keyword Args:
        seed (int, optional): Seed of the environment and its noise. Default: the seed of the run's
            test.
        noise_scale (float, optional): Standard deviation of the noise on observations. Larger
            values are more difficult. Default: the task's noise.
        best (bool): Whether to load the best policy of the tests during training
            (``evaluate_every``) instead of the last policy. Default ``False``.
        render (Drawing, optional): States to render, as for
            :func:`~torchrl_l2c2.experiment.make_env`. Default: none.

    Returns:
        tuple: Policy, environment, and maximum steps per episode.

    Raises:
        FileNotFoundError: If the folder is not a run folder, or has neither the policy nor a
            checkpoint.
        CheckpointError: If the policy or all checkpoints are damaged.
        ValueError: If ``config.json`` is damaged, or its task's module is inside the folder: the
            import would execute code that comes with the run.
        SettingError: If ``noise_scale`` is negative or not finite, or NumPy does not accept
            ``seed``.

    Warns:
        UserWarning: If the run is not finished: the policy is from its newest checkpoint.

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
    with torch.random.fork_rng(devices=[]):  # New networks use random numbers.
        env = make_env(task, seed, render=render)
        agent = make_agent(config, env)
    saved = folder / ("policy_best.pt" if best else "policy.pt")
    if saved.exists():
        _load_weights(agent.policy, saved)
    elif best:
        raise FileNotFoundError(
            f"{str(saved)!r} does not exist: train the run with evaluate_every=N, in another "
            "folder if its training is over."
        )
    elif newest := load_newest(folder):
        agent.load_networks(newest[1])
        warnings.warn(
            f"{str(folder)!r} is not finished: this is its policy after "
            f"{len(json.loads(newest[1]['metrics']))} episodes, from the newest checkpoint.",
            stacklevel=2,
        )
    else:
        raise FileNotFoundError(f"{str(folder)!r} has neither policy.pt nor a checkpoint yet.")
    return agent.policy, env, time_limit(config.task)


def seed_of_test(folder: str | Path, seed: int | None = None) -> int:
    """Returns the seed of a run's test, or another seed after a check.

    Args:
        folder (str or Path): Run folder.
        seed (int, optional): Another seed. Default: the seed of the run's test.

    Raises:
        FileNotFoundError: If the folder is not a run folder.
        ValueError: If ``config.json`` is damaged.
        SettingError: If NumPy does not accept ``seed``.
    """
    if seed is not None and not 0 <= seed < 2**32:
        raise SettingError("seed", f"must be at least 0 and below 2 ** 32, got {seed}.")
    if not (Path(folder) / "config.json").exists():
        raise FileNotFoundError(f"{str(folder)!r} is not a run folder: it has no config.json.")
    return int(read_config(folder)["seed"]) + TEST_SEED if seed is None else seed


def _check_origin(env_id: str, folder: Path) -> None:
    """Refuses a task whose module is in the run's folder, or in a package around the folder.

    Runs may come from other people, and an import executes code. Already imported modules, such as
    a script's own task, are accepted.
    """
    module = env_id.rpartition(":")[0]
    name = "" if module in sys.modules else module.partition(".")[0]
    # The top-level package is enough: submodules are found inside it.
    spec = importlib.util.find_spec(name) if name else None
    places = spec and (spec.submodule_search_locations or filter(None, [spec.origin]))
    run = folder.resolve()
    for place in [Path(place).resolve() for place in places or ()]:
        if place in (run, *run.parents) or run in place.parents:
            raise UserError(
                f"{folder / 'config.json'}: task.env_id={env_id!r} would execute {place}, which "
                "comes with the run. If you trust this code, install it or move it to your own "
                "code."
            )


def _load_weights(policy: TensorDictModule, path: Path) -> None:
    try:
        policy.load_state_dict(torch.load(path, "cpu", weights_only=True))
    except OSError:
        raise
    # For damaged files, torch raises many different errors with long messages.
    except Exception as error:
        problem = f"{path} does not contain this run's policy ({type(error).__name__})"
        raise CheckpointError(f"{problem}: {REMEDY}") from error


def save_policy(policy: torch.nn.Module, path: str | Path) -> None:
    """Writes a policy's ``state_dict``, for ``torch.load(path, weights_only=True)``."""
    content = io.BytesIO()
    torch.save({k: v.detach().clone() for k, v in policy.state_dict().items()}, content)
    write_atomically(path, content.getvalue())
