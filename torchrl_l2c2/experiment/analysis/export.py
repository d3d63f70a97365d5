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

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import OneHot
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_l2c2.experiment.agents._torchrl_internals import simulator_of
from torchrl_l2c2.experiment.agents.networks import action_bounds
from torchrl_l2c2.experiment.collect.episodes import play_episodes
from torchrl_l2c2.experiment.envs.environments import untransformed
from torchrl_l2c2.experiment.envs.pictures import control_rate
from torchrl_l2c2.experiment.envs.spaces import ZeroBasedActions
from torchrl_l2c2.experiment.errors import MissingPackageError, UserError
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
# Of the largest action there is: float32 kernels that sum in another order stay far below.
TOLERANCE = 1e-4


class MeanPolicy(nn.Module):
    """A policy's mean as a function of tensors: observations ``[B, *F]`` to actions ``[B, A]``.

    All that belongs to it is inside: layers, squashing, bounds. Discrete ones are numbers ``[B]``,
    those of the task.

    Args:
        policy (TensorDictModule): acts deterministically under ``ExplorationType.DETERMINISTIC``.
        first (int, optional): the number of the first action, where actions are one-hot vectors.
    """

    def __init__(self, policy: TensorDictModule, first: int | None = None) -> None:
        super().__init__()
        self.policy = policy
        self.first = first

    def forward(self, observation: Tensor) -> Tensor:
        """The mean actions at these observations."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            batch = TensorDict({"observation": observation}, observation.shape[:1])
            action: Tensor = self.policy(batch)["action"]
        return action if self.first is None else self.first + action.argmax(-1)


@dataclass(frozen=True)
class Exported:
    """What an export wrote.

    Attributes:
        folder: with ``policy.onnx``, ``policy.pt2`` and ``contract.json``.
        contract: what the last one says.
    """

    folder: Path
    contract: dict[str, Any]


def export_policy(
    run: str | Path, output: str | Path | None = None, *, best: bool = False, episodes: int = 1
) -> Exported:
    """Writes the mean policy of a run for use without this package, and proves that it is the same.

    ``policy.onnx`` has an input ``observation`` ``[batch, *F]`` and an output ``action``
    ``[batch, A]``, float32, or ``[batch]`` of the task's own numbers where actions are discrete;
    ``policy.pt2`` is the same as a ``torch.export`` program. ``contract.json`` says in which order
    observations and actions come, the actions' bounds, how the task's image becomes an observation,
    how often an action is due, what the run's test found, how far the exported policy is from
    PyTorch's on recorded observations, and how long one action takes.

    Args:
        run (str or Path): a run's folder.
        output (str or Path, optional): where the files go. Default: ``export/`` in the folder.

    Keyword Args:
        best (bool): whether to take ``policy_best.pt``. Default ``False``.
        episodes (int): that are played to record observations, at least 1. Default 1.

    Returns:
        Exported: the folder and the contract.

    Raises:
        ImportError: a package of the ``export`` extra is missing.
        FileNotFoundError: the folder holds no run, or no policy yet.
        OSError: the files' folder cannot be written to; no episode is played.
        UserError: the exported policy differs from PyTorch's; no file is written.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise MissingPackageError(
            f'{", ".join(missing)} is missing: pip install "torchrl-l2c2[export]" brings it.'
        )
    policy, env, max_steps = load_policy(run, best=best)
    folder = make_folder(output or Path(run) / "export")
    with ProcessState(0):
        played = play_episodes(policy, env, episodes, max_steps=max_steps)
        observations = torch.cat([episode["observation"] for episode in played])
    mean = MeanPolicy(policy, _first_action(env)).eval()
    # Two rows, also of an episode of one step: torch takes a batch of 1 for a constant.
    program, content = _translate(mean, observations[[0, -1]])
    act = _onnx_function(content)
    agreement = _compare(mean, act, observations)
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
    options.intra_op_num_threads = 1  # of one action there is nothing to share
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return lambda observation: session.run(["action"], {"observation": observation})[0]


@torch.no_grad()
def _compare(
    mean: MeanPolicy, act: Callable[[Any], Any], observations: Tensor
) -> dict[str, float | int]:
    expected = mean(observations).numpy()
    difference = float(np.abs(act(observations.numpy()) - expected).max())
    largest = float(np.abs(expected).max())
    if not difference <= TOLERANCE * max(1.0, largest):
        raise UserError(
            f"the ONNX policy differs from PyTorch's by {difference:.3g} on {len(observations)} "
            f"recorded observations, where actions go up to {largest:.3g}: it was not written."
        )
    return {"observations": len(observations), "largest_difference": difference}


def _microseconds(function: Callable[[], Any]) -> float:
    """The median time of a call, after some that are not counted."""
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
        # Of a run that has not ended there is no other.
        "policy": policy if (run / policy).exists() else "the newest checkpoint",
        "versions": versions(),
    }


def _expected(run: Path, best: bool) -> dict[str, Any]:
    """What the run's own test found of the policy, where it had one."""
    if best or not (run / "evaluation.json").exists():
        return {}
    summary = read_evaluation(run).get("summary", {})
    names = ("episodes", "return_mean", "return_std", "action_variation_mean")
    return {"test": {name: summary.get(name) for name in names}}


def _describe_observation(env: EnvBase) -> dict[str, Any]:
    shape = tuple(env.observation_spec["observation"].shape)
    seen = untransformed(env).unwrapped.observation_space
    described: dict[str, Any] = {"shape": ["batch", *shape], "dtype": "float32"}
    if len(shape) == 1:
        described["entries"] = entry_names(seen, shape[0])
    else:
        described["image"] = _describe_image(env)
    return described


def _describe_image(env: EnvBase) -> dict[str, Any]:
    """How the task's image becomes what the policy sees: scaled to 0..1, then its axes moved."""
    seeing = _wrapper(env, TransformObservation)
    image: Any = seeing.env.observation_space
    moved = image.shape != seeing.observation_space.shape and len(image.shape) == 3
    return {
        "shape": list(image.shape),
        "low": float(image.low.min()),
        "high": float(image.high.max()),
        "axes": [2, 0, 1] if moved else list(range(len(image.shape))),
    }


def _wrapper(env: EnvBase, kind: type) -> Any:
    """The outermost wrapper of a kind around the simulator; ``None`` without one."""
    wrapped = simulator_of(untransformed(env))
    while isinstance(wrapped, gymnasium.Wrapper):
        if isinstance(wrapped, kind):
            return wrapped
        wrapped = wrapped.env
    return None


def entry_names(space: Any, size: int) -> list[str]:
    """What the numbers of an observation are called: by their keys, in the order of a vector.

    Examples:
        >>> space = spaces.Dict(speed=spaces.Box(0, 1, (2,)), angle=spaces.Box(0, 1, (1,)))
        >>> entry_names(space, 3)
        ['angle[0]', 'speed[0]', 'speed[1]']
    """
    names = []
    if isinstance(space, spaces.Dict):
        for key in sorted(space.spaces):
            names += [f"{key}[{i}]" for i in range(spaces.flatdim(space[key]))]
    # A wrapper may have changed what the task shows.
    return names if len(names) == size else [f"observation[{i}]" for i in range(size)]


def _first_action(env: EnvBase) -> int | None:
    """The number that the task gives its first action; ``None`` where these are no numbers."""
    counted = _wrapper(env, ZeroBasedActions)
    first = 0 if counted is None else counted.first
    return first if isinstance(env.action_spec, OneHot) else None


def _describe_action(env: EnvBase) -> dict[str, Any]:
    spec = env.action_spec
    if (first := _first_action(env)) is not None:
        choices = {"choices": spec.shape[-1], "first": first}
        return {"shape": ["batch"], "dtype": "int64", **choices}
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
