"""Schedules of the regularizer's gain: a ramp, or a target for the action variation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from statistics import fmean
from typing import Any

from torchrl_l2c2.experiment.learn.learner import Learner
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.regularizers import GainConfig
from torchrl_l2c2.experiment.settings.tasks import Budget
from torchrl_l2c2.gains import TargetGain

MEASURE = "action_variation"  # Metric that a target limits.


class GainControl:
    """Sets the regularizer's gain after episodes.

    Args:
        config (ExperimentConfig): Settings of the run.
        learner (Learner): Learner with the regularized loss.
    """

    def __init__(self, config: ExperimentConfig, learner: Learner) -> None:
        self._learner = learner
        self._updates = 0
        # Values since the last step: several episodes may end in a rollout.
        self._seen: list[float] = []
        self._ramp = 0.0
        self._target: TargetGain | None = None
        regularizer = config.regularizer
        # None for a constant gain.
        self._config = (
            regularizer
            if isinstance(regularizer, GainConfig) and regularizer.gain != "constant"
            else None
        )
        if self._config is None:
            return
        if self._config.gain == "ramp":
            learner.at_full_gain = self._at_full_gain
        else:
            assert self._config.gain_target is not None
            self._target = TargetGain(
                self._config.gain_target, self._config.gain_rate, self._config.gain_limit
            )
            # This gain increases until it has an effect.
            learner.warns_weak_regularizer = False
        self._apply()

    def after(
        self, row: Mapping[str, float], training: Budget, *, ends_round: bool = True
    ) -> dict[str, float]:
        """Sets the gain after an episode, and returns metrics of the gain.

        The gain changes only if there was an update since its last change. A target uses the mean
        action variation over the episodes since then. With rollouts, these are the episodes that
        ended in the last rollout; without any, the gain does not change.

        Args:
            row (Mapping): Metrics of the episode. After a rollout without a finished episode, only
                ``"episode"`` and ``"frames"``.
            training (Budget): Total length of training, for a ramp.

        Keyword Args:
            ends_round (bool): Whether this is the last episode with the current policy. The gain
                changes only then. Default ``True``.

        Returns:
            dict: The gain during the episode, the measured value and the target; empty for a
            constant gain.
        """
        if self._config is None or (self._target is not None and MEASURE not in row):
            return {}
        measured = self._measure(row, training)
        logged = {"gain": self._gain, "gain_measured": measured}
        if self._target is not None:
            logged["gain_target"] = self._target.target
        if ends_round and self._learner.updates > self._updates:
            self._updates, self._seen = self._learner.updates, []
            if self._target is None:
                self._ramp = min(1.0, measured / self._config.gain_length)
            else:
                self._target.step(measured)
            self._apply()
        return logged

    def state_dict(self) -> dict[str, Any]:
        """Returns the gain, the update of its last change, and the values measured since."""
        gains = {} if self._config is None else {"all": {"value": self._gain}}
        return {"gains": gains, "updates": self._updates, "seen": list(self._seen)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state of :meth:`state_dict`, and sets the loss's gain."""
        if self._config is None:
            return
        if self._target is None:
            self._ramp = state["gains"]["all"]["value"]
        else:
            self._target.load_state_dict(state["gains"]["all"])
        self._updates, self._seen = state["updates"], list(state["seen"])
        self._apply()

    @property
    def _gain(self) -> float:
        """Gain without the strength."""
        return self._ramp if self._target is None else self._target.value

    def _apply(self, gain: float | None = None) -> None:
        assert self._config is not None
        gain = self._gain if gain is None else gain
        self._learner.agent.loss.regularizer_gain = self._config.strength * gain

    @contextmanager
    def _at_full_gain(self) -> Iterator[None]:
        self._apply(1.0)
        try:
            yield
        finally:
            self._apply()

    def _measure(self, row: Mapping[str, float], training: Budget) -> float:
        if self._target is None:
            spent = training.spent(int(row["episode"]), int(row["frames"]))
            return min(1.0, spent / training.total)  # The last round may exceed the total.
        self._seen.append(row[MEASURE])
        numbers = [measured for measured in self._seen if math.isfinite(measured)]
        return fmean(numbers) if numbers else self._seen[-1]
