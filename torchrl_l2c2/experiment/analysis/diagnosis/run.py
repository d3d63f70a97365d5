"""Diagnosis of a run: its policy, its value function and its training."""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from gymnasium.error import DependencyNotInstalled
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.agents.build import make_agent
from torchrl_l2c2.experiment.agents.normalization import Normalization
from torchrl_l2c2.experiment.agents.regularizers import make_neighborhood
from torchrl_l2c2.experiment.analysis.diagnosis.measured import (
    Diagnosis,
    TermShare,
    Value,
    diagnose,
)
from torchrl_l2c2.experiment.analysis.export import entry_names
from torchrl_l2c2.experiment.analysis.video import play_pictures
from torchrl_l2c2.experiment.collect.episodes import play_episodes
from torchrl_l2c2.experiment.envs.environments import TEST_SEED, untransformed
from torchrl_l2c2.experiment.envs.frames import PREVIOUS
from torchrl_l2c2.experiment.envs.pictures import Drawing
from torchrl_l2c2.experiment.errors import SimulatorError
from torchrl_l2c2.experiment.run.checkpoints import load_newest
from torchrl_l2c2.experiment.run.files import read_config, read_rows
from torchrl_l2c2.experiment.run.finished import LATE
from torchrl_l2c2.experiment.run.policies import load_policy
from torchrl_l2c2.experiment.run.process import ProcessState
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.regularizers import GainConfig
from torchrl_l2c2.gains import gradient_shares
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives._evaluation import EvaluatedNetworks
from torchrl_l2c2.objectives._networks import VALUE_NETWORKS, is_ensemble

# The film of the page. Without a graphics card, drawing takes most of the time.
DRAWING = Drawing(rate=30.0, seconds=10.0, quick=True)


def diagnose_run(
    folder: str | Path,
    *,
    name: str | None = None,
    episodes: int = 3,
    seed: int = TEST_SEED,
    noise_scale: float | None = None,
    best: bool = False,
    with_pictures: bool = True,
) -> Diagnosis:
    """Diagnoses a run's policy, with its own neighborhood, value function and training.

    With ``algorithm.normalize_observations``, the neighborhood is without ``max_step``, which is
    in standard deviations then: the policy reads observations that are not normalized.

    Args:
        folder (str or Path): The run's folder, finished or not.

    Keyword Args:
        name (str, optional): Name of the run. Default: the folder.
        episodes (int): as for :func:`~.measured.diagnose`. Default 3.
        seed (int): Seed of the environment and its noise; use the same one to compare runs.
        noise_scale (float, optional): Scale of the environment's noise. Default: the task's noise.
            Without noise, sensitivity is measured with 0.01.
        best (bool): whether to take ``policy_best.pt``. Default ``False``.
        with_pictures (bool): whether the first episode is drawn as well. Default ``True``.

    Returns:
        Diagnosis: with the shares of the loss's terms (not of the best policy, whose loss was not
        kept), and with pictures where they were wanted and the task draws any.

    Raises:
        FileNotFoundError: the folder holds no run, or no policy yet.

    Warns:
        UserWarning: pictures were wanted, and the task draws none; says why.
    """
    folder = Path(folder)
    policy, env, max_steps = load_policy(folder, seed=seed, noise_scale=noise_scale, best=best)
    config = ExperimentConfig.from_dict(read_config(folder))
    noise = config.task.noise_scale if noise_scale is None else noise_scale
    # What learned is of the checkpoint's policy, and not of the best one's.
    agent = None if best else _trained(folder, config, env)
    with ProcessState(seed):
        found = diagnose(
            policy,
            env,
            name=name or str(folder),
            episodes=episodes,
            max_steps=max_steps,
            neighborhood=_neighborhood(config),
            value=None if agent is None else value_function(agent.loss, agent.normalization),
            noise_scale=noise or 0.01,
        )
        shares = _shares(folder, config, agent, env, max_steps)
    seen = untransformed(env).unwrapped.observation_space
    entries = entry_names(seen, found.observations.shape[1])
    env.close()
    pictures, every = _pictures(folder, seed, noise_scale, best) if with_pictures else ([], 1)
    task = config.task.env_id
    return replace(
        found, task=task, shares=shares, entries=entries, pictures=pictures, picture_every=every
    )


def value_function(loss: LossModule, normalization: Normalization | None = None) -> Value | None:
    """The value function of a loss, all of its heads; ``None`` where it has none.

    Args:
        loss (LossModule): A loss that declares the keys of its networks.
        normalization (Normalization, optional): Normalization of its observations. Default: none.

    Returns:
        callable: observations ``[N, *F]`` and actions ``[N, *A]`` to values ``[N, M]``. State
        values do not look at the action.
    """
    present = [name for name in VALUE_NETWORKS if getattr(loss, name, None) is not None]
    if not present:
        return None
    network, evaluation = present[0], EvaluatedNetworks()
    evaluation.inspect(loss, [network])
    dim = int(is_ensemble(loss, network))

    def value(observation: Tensor, action: Tensor) -> Tensor:
        if normalization is not None:
            observation = normalization.normalize(observation)
        batch = TensorDict({"observation": observation, "action": action}, observation.shape[:1])
        states = batch.select("observation").unsqueeze(0)
        _, there = evaluation.values_at(loss, network, batch, states)
        # From [M, 1, N, H] of an ensemble, [1, N, H] of one network.
        return there.movedim(dim + 1, 0).flatten(1)

    return value


def _neighborhood(config: ExperimentConfig) -> Neighborhood | None:
    near = make_neighborhood(config.regularizer)
    if near is not None and getattr(config.algorithm, "normalize_observations", False):
        return replace(near, max_step=None)
    return near


def _trained(folder: Path, config: ExperimentConfig, env: EnvBase) -> Agent | None:
    """The agent of the newest checkpoint; ``None`` without one."""
    newest = load_newest(folder)
    if newest is None:
        return None
    agent = make_agent(replace(config, device="cpu"), env)
    agent.load_networks(newest[1])
    gains = newest[1].get("gain", {}).get("gains", {})
    if gains and isinstance(config.regularizer, GainConfig):
        agent.loss.regularizer_gain = config.regularizer.strength * gains["all"]["value"]
    return agent


def _shares(
    folder: Path, config: ExperimentConfig, agent: Agent | None, env: EnvBase, max_steps: int
) -> dict[str, TermShare]:
    """Of the metrics, and of the gradients at a training episode that is played for them."""
    sizes = _sizes(folder / "metrics.csv")
    gradients: Mapping[str, float] = {}
    added: Iterable[str] = ()
    if agent is not None:
        added = getattr(agent.loss, "added_terms", ())
        if added:
            with torch.enable_grad():
                gradients = gradient_shares(agent.loss, _batch(agent, config, env, max_steps))
    names = dict.fromkeys([*sizes, *(key.removeprefix("loss_") for key in gradients)])
    return {
        name: TermShare(
            added=f"loss_{name}" in added,
            size=sizes.get(name, math.nan),
            gradient=gradients.get(f"loss_{name}", math.nan),
        )
        for name in names
    }


def _sizes(path: Path) -> dict[str, float]:
    if not path.exists():
        return {}
    _, rows = read_rows(path)
    late = rows[-max(1, round(LATE * len(rows))) :]
    columns = [name for name in (late[-1] if late else {}) if name.split("_")[0] == "share"]
    known = {
        name: [v for row in late if not math.isnan(v := float(row[name] or "nan"))]
        for name in columns
    }
    return {
        name.replace("share", "loss", 1).removeprefix("loss_"): statistics.fmean(values)
        for name, values in known.items()
        if values
    }


def _batch(agent: Agent, config: ExperimentConfig, env: EnvBase, max_steps: int) -> TensorDictBase:
    """A training episode, with what the loss reads of it."""
    (episode,) = play_episodes(agent.policy, env, 1, max_steps=max_steps, sampled=True)
    with torch.no_grad():
        seen = episode["observation"]
        episode.set(PREVIOUS, torch.cat((seen[:1], seen[:-1])))
        if agent.normalization is not None:
            episode = agent.normalization.normalized(episode)
        return agent.prepare_for_loss(episode, config.algorithm.reward_factor)


def _pictures(
    folder: Path, seed: int, noise_scale: float | None, best: bool
) -> tuple[list[Any], int]:
    """The pictures of the first test episode, and the steps from one to the next."""
    try:
        (played,) = play_pictures(
            folder, 1, seed=seed, noise_scale=noise_scale, best=best, drawing=DRAWING
        )
    # The task draws no pictures, or a package is missing.
    except (ValueError, DependencyNotInstalled, SimulatorError) as error:
        warnings.warn(f"there is no video: {error}", stacklevel=3)
        return [], 1
    return played.pictures, played.every
