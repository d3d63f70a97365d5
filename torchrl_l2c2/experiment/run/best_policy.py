"""Evaluations during training, and the policy with the best evaluation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule

from torchrl_l2c2.experiment.envs.environments import TEST_SEED
from torchrl_l2c2.experiment.run.evaluation import evaluate_task
from torchrl_l2c2.experiment.run.files import write_json
from torchrl_l2c2.experiment.run.policies import save_policy
from torchrl_l2c2.experiment.settings.config import ExperimentConfig

EPISODES = 10


class BestPolicy:
    """Tests the policy at intervals and keeps the policy with the highest mean return.

    A test has 10 episodes with mean actions, the same episodes every time. It uses its own
    environment and does not affect training. The final test plays other episodes, on which the best
    policy was not selected.

    Args:
        config (ExperimentConfig): Settings of the run. ``evaluate_every`` is the number of training
            episodes between tests; 0: no tests.
        policy (TensorDictModule): Policy that is deterministic under
            ``ExplorationType.DETERMINISTIC``.
        folder (Path, optional): Folder of ``evaluations.json`` and ``policy_best.pt``. ``None``:
            nothing is written.

    Attributes:
        tests: Summaries of the tests, each with its training ``episode``.
    """

    def __init__(
        self, config: ExperimentConfig, policy: TensorDictModule, folder: Path | None
    ) -> None:
        self._task, self._seed = config.task, config.seed
        self._policy, self._folder, self._every = policy, folder, config.evaluate_every
        self.tests: list[dict[str, float]] = []

    def after(self, episode: int) -> None:
        """Tests the policy if a test is due after this training episode."""
        if not self._every or episode % self._every:
            return
        seed, threads = self._seed + 2 * TEST_SEED, torch.get_num_threads()
        result = evaluate_task(self._policy, self._task, seed, EPISODES, threads=threads)
        self.tests.append({"episode": episode, **result.summary()})
        if self._folder is None:
            return
        if self.best() is self.tests[-1]:
            save_policy(self._policy, self._folder / "policy_best.pt")
        write_json(self._folder / "evaluations.json", self.tests)

    def best(self) -> dict[str, float]:
        """Returns the first test with the highest mean return."""
        return max(self.tests, key=lambda test: test["return_mean"])

    def state_dict(self) -> dict[str, Any]:
        """Returns the summaries of the tests as JSON."""
        return {"tests": json.dumps(self.tests)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`state_dict`."""
        self.tests = json.loads(state["tests"])
