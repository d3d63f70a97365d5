"""Export of a policy's mean action: ONNX, a ``torch.export`` program, and a contract.

``python -m torchrl_l2c2 export FOLDER`` exports the policy of a run.
"""

from __future__ import annotations

import io
import logging
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
from torchrl_l2c2.experiment.envs.spaces import CountedFromZero
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
# Relative to the largest action; other orders of float32 sums differ far less.
TOLERANCE = 1e-4


class MeanPolicy(nn.Module):
    """A policy's mean as a function of tensors: observations ``[B, *F]`` to actions ``[B, A]``.

    Layers, squashing and bounds are inside. Discrete actions are the task's numbers ``[B]``.

    Args:
        policy (TensorDictModule): The policy; ``ExplorationType.DETERMINISTIC`` selects its mean.
        first (int, optional): Number of the first action, if actions are one-hot vectors.
    """

    def __init__(self, policy: TensorDictModule, first: int | None = None) -> None:
        super().__init__()
        self.policy = policy
        self.first = first

    def forward(self, observation: Tensor) -> Tensor:
        """Returns the mean actions at observations."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            batch = TensorDict({"observation": observation}, observation.shape[:1])
            action: Tensor = self.policy(batch)["action"]
        return action if self.first is None else self.first + action.argmax(-1)


@dataclass(frozen=True)
class Exported:
    """The files of an export.

    Attributes:
        folder: the folder of ``policy.onnx``, ``policy.pt2`` and ``contract.json``.
        contract: the content of ``contract.json``.
    """

    folder: Path
    contract: dict[str, Any]


def export_policy(
    run: str | Path, output: str | Path | None = None, *, best: bool = False, episodes: int = 1
) -> Exported:
    """Writes the mean policy of a run for use without this package, and compares it with PyTorch.

    ``policy.onnx`` has an input ``observation`` ``[batch, *F]`` and an output ``action``
    ``[batch, A]``, float32, or ``[batch]`` of the task's own numbers where actions are discrete;
    ``policy.pt2`` is the same as a ``torch.export`` program. ``contract.json`` has the order of
    observations and actions, the bounds of the actions, the conversion of images, the control
    rate, the results of the run's test, and the largest difference between the exported policy
    and PyTorch on recorded observations.

    Args:
        run (str or Path): The run's folder.
        output (str or Path, optional): Folder of the files. Default: ``export/`` in the run's
            folder.

    Keyword Args:
        best (bool): Whether to take ``policy_best.pt``. Default ``False``.
        episodes (int): Number of episodes in which observations are recorded, at least 1.
            Default 1.

    Returns:
        Exported: The folder and the contract.

    Raises:
        ImportError: a package of the ``export`` extra is missing.
        FileNotFoundError: the folder holds no run, or no policy yet.
        OSError: the files' folder cannot be written to; no episode is played.
        UserError: the exported policy differs from PyTorch; no file is written.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise MissingPackageError(
            f"Expected the packages of the export extra, got none of {', '.join(missing)}. "
            'Run pip install "torchrl-l2c2[export]".'
        )
    policy, env, max_steps = load_policy(run, best=best)
    folder = make_folder(output or Path(run) / "export")
    with ProcessState(0):
        played = play_episodes(policy, env, episodes, max_steps=max_steps)
        observations = torch.cat([episode["observation"] for episode in played])
    mean = MeanPolicy(policy, _first_action(env)).eval()
    # Two rows, also for an episode of one step: torch treats a batch of 1 as a constant.
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
    options.intra_op_num_threads = 1  # A single action is too small for several threads.
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
            f"Expected the actions of PyTorch from the ONNX policy, got a difference of "
            f"{difference:.3g} on {len(observations)} recorded observations with actions up to "
            f"{largest:.3g}. No file was written; report this policy."
        )
    return {"observations": len(observations), "largest_difference": difference}


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
    """The results of the run's own test of the policy, if it had one."""
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
    """The conversion of the task's image for the policy: scaled to 0..1, then its axes moved."""
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
    """Names of the coordinates of an observation: keys, in the order of the vector.

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


def _first_action(env: EnvBase) -> int | None:
    """The task's number of its first action; ``None`` if actions are not discrete."""
    counted = _wrapper(env, CountedFromZero)
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
