"""How strong the regularizer is during a run, where its gain sets itself."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from statistics import fmean
from typing import Any

from torchrl_l2c2.experiment.config import ExperimentConfig
from torchrl_l2c2.experiment.evaluate import TESTED
from torchrl_l2c2.experiment.learner import Learner
from torchrl_l2c2.experiment.player import EPISODE_COLUMNS
from torchrl_l2c2.experiment.regularizers import GainConfig
from torchrl_l2c2.experiment.settings import SettingError
from torchrl_l2c2.experiment.tasks import Budget
from torchrl_l2c2.gains import ConstantGain, GradientGain, RampGain, TargetGain


class GainControl:
    """Sets the regularizer's gains between the updates of two episodes, and reports them.

    Args:
        config (ExperimentConfig): whose regularizer says how; a constant gain is none of this
            class's business.
        learner (Learner): whose loss has the gains.

    Raises:
        SettingError: the regularizer's gain is to follow what is not measured.

    Attributes:
        gains: of the networks that have one of their own, ``"policy"`` and ``"value"``, or of all.
    """

    def __init__(self, config: ExperimentConfig, learner: Learner) -> None:
        regularizer = config.regularizer
        self._learner, self._updates = learner, 0
        self._config: GainConfig | None = None  # Of a gain that sets itself.
        self._tells_measured = True
        # Of the episodes since the gain was set: of a rollout several end, and any one is noisy.
        self._seen: list[float] = []
        self.gains: dict[str, ConstantGain] = {}
        if isinstance(regularizer, GainConfig) and regularizer.gain != "constant":
            self._config = regularizer
            names = self._terms() if regularizer.gain == "gradient" else ["all"]
            self.gains = {name: _make_gain(regularizer, name) for name in names}
            if regularizer.gain == "target":
                self._check_column(regularizer.gain_of, tested=config.late_share > 0)
            # Gains that follow a measure rise by themselves; a ramp ends where it ends.
            learner.tells_faint_regularizer = regularizer.gain == "ramp"
            learner.at_full_gain = self._at_full_gain
            self._apply()

    def after(
        self, row: Mapping[str, float], training: Budget, *, ends_round: bool = True
    ) -> dict[str, float]:
        """Sets the gains for what follows an episode; gives what they were and were set from.

        Without an update since the last time nothing is set, and no gradient measured. Where one
        is, a measure is the mean over the episodes since then: with rollouts, those of the last.
        After a rollout that no episode ended in, a target has nothing to be set from.

        Args:
            row (Mapping): what is logged of the episode; without one, how many ``"episode"`` and
                ``"frames"`` there were.
            training (Budget): all of it, over which a ramp rises.

        Keyword Args:
            ends_round (bool): whether it is the last that was played with the same policy; the
                gains stay as they are till then. Default ``True``.

        Returns:
            dict: the gains that were applied, what was measured, and the target; empty where the
            gain is constant.
        """
        config = self._config
        if config is None or (config.gain == "target" and config.gain_of not in row):
            return {}
        logged = {}
        due = ends_round and self._learner.updates > self._updates
        measured = self._measure(config, row, training, due)
        for name, gain in self.gains.items():
            suffix = "" if name == "all" else f"_{name}"
            logged[f"gain{suffix}"] = gain.value
            logged[f"gain_measured{suffix}"] = measured[name]
        logged |= config.targets
        if due:
            self._updates, self._seen = self._learner.updates, []
            for name, gain in self.gains.items():
                gain.step(measured[name])
            self._apply()
            if config.gain == "target":
                self._tell_measured(config.gain_of, measured["all"])
        return logged

    def state_dict(self) -> dict[str, Any]:
        """The gains, the updates that they have followed, and what was measured since."""
        gains = {name: gain.state_dict() for name, gain in self.gains.items()}
        return {"gains": gains, "updates": self._updates, "seen": list(self._seen)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave; the loss has the gains then, too."""
        for name, gain in self.gains.items():
            gain.load_state_dict(state["gains"][name])
        self._updates, self._seen = state["updates"], list(state.get("seen", []))
        self._apply()

    @contextmanager
    def _at_full_gain(self) -> Iterator[None]:
        assert self._config is not None
        self._config.apply(self._learner.agent.loss, {"all": 1.0})
        try:
            yield
        finally:
            self._apply()

    def _apply(self) -> None:
        if self._config is None:
            return
        values = {name: gain.value for name, gain in self.gains.items()}
        self._config.apply(self._learner.agent.loss, values)

    def _terms(self) -> dict[str, list[str]]:
        """The regularizer's terms, by what they train."""
        loss = self._learner.agent.loss
        of_policy = loss.policy_terms
        of_value = loss.added_terms - of_policy - loss.auxiliary_terms
        terms = {"policy": sorted(of_policy), "value": sorted(of_value)}
        return {name: keys for name, keys in terms.items() if keys}

    def _measure(
        self, config: GainConfig, row: Mapping[str, float], training: Budget, due: bool
    ) -> dict[str, float]:
        if config.gain == "ramp":
            spent = training.spent(int(row["episode"]), int(row["frames"]))
            return {"all": min(1.0, spent / training.total)}  # A last round may go beyond it.
        if config.gain == "target":
            self._seen.append(row[config.gain_of])
            numbers = [measured for measured in self._seen if math.isfinite(measured)]
            return {"all": fmean(numbers) if numbers else self._seen[-1]}
        if not due:
            return dict.fromkeys(self.gains, math.nan)
        shares = self._learner.shares(self._learner.example())
        return {
            name: max((shares[key] for key in keys if key in shares), default=math.nan)
            for name, keys in self._terms().items()
        }

    def _check_column(self, name: str, *, tested: bool) -> None:
        """Which columns will have numbers is known before anything is played."""
        columns = {*EPISODE_COLUMNS, *self._learner.report(0), *(TESTED if tested else ())}
        if "scale" not in self._learner.agent.policy.out_keys:
            columns.remove("policy_scale")
        if name not in columns:
            raise SettingError(
                "regularizer.gain_of",
                f"must be one of {sorted(columns)}, got {name!r} (test_* need a late_share, and "
                "policy_scale a policy that has a scale).",
            )

    def _tell_measured(self, column: str, measured: float) -> None:
        """Says once that a target is not followed, as its column has no fitting number."""
        if 0.0 <= measured < math.inf or not self._tells_measured:
            return
        self._tells_measured = False
        warnings.warn(
            f"regularizer.gain_of={column} is {measured:g} after update {self._updates}: the gain "
            "stays where that is no number, and falls where it is below 0, whatever gain_target "
            "is. Choose a column of numbers of at least 0; test_* have some in the last late_share "
            "of training alone.",
            stacklevel=4,
        )


def _make_gain(config: GainConfig, name: str) -> ConstantGain:
    if config.gain == "ramp":
        return RampGain(length=config.gain_length)
    target = config.targets.get(f"gain_target_{name}", config.targets["gain_target"])
    if not target:
        return ConstantGain(0.0)
    kind = GradientGain if config.gain == "gradient" else TargetGain
    return kind(target, config.gain_rate, config.gain_limit)
