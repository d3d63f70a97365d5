"""The schedule of the regularizer's gain in a run: a ramp, or a gain that follows a metric."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from statistics import fmean
from typing import Any

from torchrl_l2c2.experiment.collect.player import EPISODE_COLUMNS
from torchrl_l2c2.experiment.learn.learner import Learner
from torchrl_l2c2.experiment.run.evaluation import TESTED
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.experiment.settings.regularizers import GainConfig
from torchrl_l2c2.experiment.settings.tasks import Budget
from torchrl_l2c2.gains import ConstantGain, RampGain, TargetGain


class GainControl:
    """Sets the regularizer's gain after episodes, and logs it.

    Args:
        config (ExperimentConfig): the settings.
        learner (Learner): the learner with the loss.

    Raises:
        SettingError: the gain follows a column that the run does not have.

    Attributes:
        gain: schedule of the gain; ``None`` for a constant gain.
    """

    def __init__(self, config: ExperimentConfig, learner: Learner) -> None:
        self._learner = learner
        self._updates = 0
        self._warns_of_measure = True
        # Values since the last step: a rollout may end several episodes, and each is noisy.
        self._seen: list[float] = []
        self.gain: ConstantGain | None = None
        if not isinstance(config.regularizer, GainConfig):
            return
        self._config = config.regularizer
        if self._config.gain == "ramp":
            self.gain = RampGain(length=self._config.gain_length)
            learner.at_full_gain = self._at_full_gain
        elif self._config.gain == "target":
            assert self._config.gain_target is not None
            self._check_column(self._config.gain_of, tested=config.late_share > 0)
            self.gain = TargetGain(
                self._config.gain_target, self._config.gain_rate, self._config.gain_limit
            )
            # This gain rises by itself until it has an effect.
            learner.warns_weak_regularizer = False
        self._apply()

    def after(
        self, row: Mapping[str, float], training: Budget, *, ends_round: bool = True
    ) -> dict[str, float]:
        """Sets the gain after an episode, and returns the entries to log.

        The gain changes only if there was an update since its last change. A target uses the mean
        of its metric over the episodes since then, which with rollouts are the episodes that ended
        in the last rollout. Without such an episode the gain stays.

        Args:
            row (Mapping): the episode's metrics; without an episode, ``"episode"`` and
                ``"frames"``.
            training (Budget): the whole training, over which a ramp rises.

        Keyword Args:
            ends_round (bool): whether this is the last episode with the current policy. The gain
                changes only then. Default ``True``.

        Returns:
            dict: the gain that was applied, the measured value and the target; empty for a constant
            gain.
        """
        if self.gain is None or (self._config.gain == "target" and self._config.gain_of not in row):
            return {}
        measured = self._measure(row, training)
        logged = {"gain": self.gain.value, "gain_measured": measured}
        if self._config.gain_target is not None:
            logged["gain_target"] = self._config.gain_target
        if ends_round and self._learner.updates > self._updates:
            self._updates, self._seen = self._learner.updates, []
            self.gain.step(measured)
            self._apply()
            if self._config.gain == "target":
                self._warn_of_measure(self._config.gain_of, measured)
        return logged

    def state_dict(self) -> dict[str, Any]:
        """The gain, the update of its last change, and the values measured since."""
        gains = {} if self.gain is None else {"all": self.gain.state_dict()}
        return {"gains": gains, "updates": self._updates, "seen": list(self._seen)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned, and sets the loss's gain."""
        if self.gain is None:
            return
        self.gain.load_state_dict(state["gains"]["all"])
        self._updates, self._seen = state["updates"], list(state.get("seen", []))
        self._apply()

    @contextmanager
    def _at_full_gain(self) -> Iterator[None]:
        self._learner.agent.loss.regularizer_gain = self._config.strength
        try:
            yield
        finally:
            self._apply()

    def _apply(self) -> None:
        gain = 1.0 if self.gain is None else self.gain.value
        self._learner.agent.loss.regularizer_gain = self._config.strength * gain

    def _measure(self, row: Mapping[str, float], training: Budget) -> float:
        if self._config.gain == "ramp":
            spent = training.spent(int(row["episode"]), int(row["frames"]))
            return min(1.0, spent / training.total)  # The last round may exceed the total.
        self._seen.append(row[self._config.gain_of])
        numbers = [measured for measured in self._seen if math.isfinite(measured)]
        return fmean(numbers) if numbers else self._seen[-1]

    def _check_column(self, name: str, *, tested: bool) -> None:
        """Refuses a column that the run will not have, before the run begins."""
        columns = {*EPISODE_COLUMNS, *self._learner.report(0), *(TESTED if tested else ())}
        if "scale" not in self._learner.agent.policy.out_keys:
            columns.remove("policy_scale")
        if name not in columns:
            raise SettingError(
                "regularizer.gain_of",
                f"must be one of {sorted(columns)}, got {name!r} (test_* need a late_share, and "
                "policy_scale a policy that has a scale).",
            )

    def _warn_of_measure(self, column: str, measured: float) -> None:
        """Warns once if the column of a target is negative or not finite."""
        if 0.0 <= measured < math.inf or not self._warns_of_measure:
            return
        self._warns_of_measure = False
        warnings.warn(
            f"regularizer.gain_of={column} is {measured:g} after update {self._updates}: the gain "
            "stays if this is not a number, and falls if it is below 0, for any gain_target. "
            "Choose a column of numbers of at least 0. test_* columns have numbers only in the "
            "last late_share of training.",
            stacklevel=4,
        )
