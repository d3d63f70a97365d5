"""A policy to take away: its mean as ONNX and as a ``torch.export`` program, with a contract.

``python -m torchrl_l2c2 export FOLDER`` makes them of a run's policy.
"""

from __future__ import annotations

import io
import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_l2c2.experiment.agents.networks import action_bounds
from torchrl_l2c2.experiment.collect.episodes import play_episodes
from torchrl_l2c2.experiment.envs.environments import untransformed
from torchrl_l2c2.experiment.envs.pictures import control_rate
from torchrl_l2c2.experiment.errors import MissingPackageError, UserError, how_to_install
from torchrl_l2c2.experiment.run.files import (
    make_folder,
    read_config,
    read_evaluation,
    write_atomically,
    write_json,
)
from torchrl_l2c2.experiment.run.folder import versions
from torchrl_l2c2.experiment.run.policies import load_policy
from torchrl_l2c2.experiment.run.process import ProcessState

NEEDED = ("onnx", "onnxruntime", "onnxscript")
# Share of the largest action. float32 kernels that sum in another order differ by far less.
TOLERANCE = 1e-4


class MeanPolicy(nn.Module):
    """A policy's mean action as a function of tensors: ``[B, F]`` to ``[B, A]``.

    It contains the layers, the squashing and the bounds.

    Args:
        policy (TensorDictModule): The policy, deterministic under
            ``ExplorationType.DETERMINISTIC``.
    """

    def __init__(self, policy: TensorDictModule) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor) -> Tensor:
        """Returns the mean actions at the observations."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            batch = TensorDict({"observation": observation}, observation.shape[:1])
            action: Tensor = self.policy(batch)["action"]
        return action


@dataclass(frozen=True)
class Exported:
    """Result of an export.

    Attributes:
        folder: Folder of ``policy.onnx``, ``policy.pt2`` and ``contract.json``.
        contract: Content of ``contract.json``.
    """

    folder: Path
    contract: dict[str, Any]


def export_policy(
    run: str | Path, output: str | Path | None = None, *, best: bool = False, episodes: int = 1
) -> Exported:
    """Writes the mean policy of a run for use without this package, and checks its actions.

    ``policy.onnx`` has an input ``observation`` ``[batch, F]`` and an output ``action``
    ``[batch, A]``, float32. ``policy.pt2`` is the same policy as a ``torch.export`` program.
    ``contract.json`` has the order of observations and actions, the bounds of the actions, the
    control rate, the run's test results, the largest difference from PyTorch's actions on recorded
    observations, and the time of one action.

    Args:
        run (str or Path): The run's folder.
        output (str or Path, optional): Folder of the files. Default: ``export/`` in the run's
            folder.

    Keyword Args:
        best (bool): Whether to export ``policy_best.pt``. Default ``False``.
        episodes (int): Number of episodes to record observations from, at least 1. Default 1.

    Returns:
        Exported: The folder and the contract.

    Raises:
        ImportError: If a package of the ``export`` extra is missing.
        FileNotFoundError: If the folder has no run, or no policy yet.
        OSError: If the folder of the files cannot be written to; no episode is played.
        UserError: If the exported policy differs from PyTorch's; no file is written.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise MissingPackageError(
            f"Expected the packages of the export extra, {', '.join(missing)} not installed. "
            f"{how_to_install('export')}"
        )
    policy, env, max_steps = load_policy(run, best=best)
    folder = make_folder(output or Path(run) / "export")
    with ProcessState(0):
        played = play_episodes(policy, env, episodes, max_steps=max_steps)
        observations = torch.cat([episode["observation"] for episode in played])
    mean = MeanPolicy(policy).eval()
    # Two rows, even if an episode has one step: torch treats a batch of 1 as a constant.
    program, content = _translate(mean, observations[[0, -1]])
    act = _onnx_function(content)
    agreement = _compare(mean, act, observations, "ONNX")
    run_program = program.module()
    _compare(mean, lambda batch: run_program(torch.from_numpy(batch)), observations, "torch.export")
    contract = {
        **_origin(Path(run), best),
        "observation": _describe_observation(env),
        "action": _describe_action(env),
        "actions_per_second": control_rate(env),
        "longest_episode": max_steps,
        **_expected(Path(run), best),
        "agreement": agreement,
        "microseconds_per_action": {
            "onnxruntime": _microseconds(lambda: act(observations[:1].numpy())),
            "torch": _microseconds(lambda: mean(observations[:1])),
        },
    }
    env.close()
    write_atomically(folder / "policy.onnx", content)
    saved = io.BytesIO()
    torch.export.save(program, saved)
    write_atomically(folder / "policy.pt2", saved.getvalue())
    write_json(folder / "contract.json", contract)
    return Exported(folder, contract)


def _translate(mean: MeanPolicy, observations: Tensor) -> tuple[Any, bytes]:
    batch = torch.export.Dim("batch")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        program = torch.export.export(mean, (observations,), dynamic_shapes=({0: batch},))
        made = torch.onnx.export(
            program,
            input_names=["observation"],
            output_names=["action"],
            dynamo=True,
            verbose=False,
        )
    assert made is not None
    return program, made.model_proto.SerializeToString()


def _onnx_function(content: bytes) -> Callable[[Any], Any]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # one action is too little work for several threads
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return lambda observation: session.run(["action"], {"observation": observation})[0]


@torch.no_grad()
def _compare(
    mean: MeanPolicy, act: Callable[[Any], Any], observations: Tensor, kind: str
) -> dict[str, float | int]:
    expected = mean(observations).numpy()
    difference = float(np.abs(np.asarray(act(observations.numpy())) - expected).max())
    largest = float(np.abs(expected).max())
    if not difference <= TOLERANCE * max(1.0, largest):
        raise UserError(
            f"the {kind} policy differs from PyTorch's by {difference:.3g} on {len(observations)} "
            f"recorded observations with actions up to {largest:.3g}. No file was written."
        )
    return {"observations": len(observations), "largest_difference": difference}


def _microseconds(function: Callable[[], Any]) -> float:
    """Measures the median time of a call, after a warm-up."""
    times = []
    with torch.no_grad():
        for _ in range(220):
            started = time.perf_counter()
            function()
            times.append(time.perf_counter() - started)
    return round(1e6 * float(np.median(times[20:])), 2)


def _origin(run: Path, best: bool) -> dict[str, Any]:
    config = read_config(run)
    policy = "policy_best.pt" if best else "policy.pt"
    return {
        "task": config["task"]["env_id"],
        "noise_scale": config["task"]["noise_scale"],
        "algorithm": config["algorithm"]["name"],
        "regularizer": config["regularizer"]["name"],
        "seed": config["seed"],
        # An unfinished run has only checkpoints.
        "policy": policy if (run / policy).exists() else "the newest checkpoint",
        "versions": versions(),
    }


def _expected(run: Path, best: bool) -> dict[str, Any]:
    """Returns the results of the run's own test, if there was one."""
    if best or not (run / "evaluation.json").exists():
        return {}
    summary = read_evaluation(run).get("summary", {})
    names = ("episodes", "return_mean", "return_std", "action_variation_mean")
    return {"test": {name: summary.get(name) for name in names}}


def _describe_observation(env: EnvBase) -> dict[str, Any]:
    size = env.observation_spec["observation"].shape[-1]
    names = entry_names(untransformed(env).unwrapped.observation_space, size)
    return {"shape": ["batch", size], "dtype": "float32", "entries": names}


def entry_names(space: Any, size: int) -> list[str]:
    """Names the entries of an observation vector by their keys, in the order of the vector.

    Examples:
        >>> space = spaces.Dict(speed=spaces.Box(0, 1, (2,)), angle=spaces.Box(0, 1, (1,)))
        >>> entry_names(space, 3)
        ['angle[0]', 'speed[0]', 'speed[1]']
    """
    names = []
    if isinstance(space, spaces.Dict):
        for key in sorted(space.spaces):
            names += [f"{key}[{i}]" for i in range(spaces.flatdim(space[key]))]
    # A wrapper may have changed the observation.
    return names if len(names) == size else [f"observation[{i}]" for i in range(size)]


def _describe_action(env: EnvBase) -> dict[str, Any]:
    spec = env.action_spec
    size = spec.shape[-1]
    described = {
        "shape": ["batch", size],
        "dtype": "float32",
        "entries": [f"action[{i}]" for i in range(size)],
    }
    if bounds := action_bounds(env):
        low, high = bounds
        described |= {"low": low.tolist(), "high": high.tolist()}
    return described
