"""Presets of the regularizers, in one table by method and kind of loss.

Losses are given by class name: the table can be read without importing torch.
:func:`torchrl_l2c2.smooth` applies the presets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

NEIGHBORHOOD_FIELDS = frozenset({"sigma", "lambda_min", "lambda_max", "neighbors", "max_step"})
"""Settings of L2C2 that are fields of ``Neighborhood``."""


@dataclass(frozen=True)
class Preset:
    """Settings of a regularizer for a kind of loss.

    Attributes:
        settings: keyword arguments of the regularizer, and of its ``Neighborhood``.
        ramp: share of training over which the gain rises from 0; ``None`` for a constant gain.
        relative: whether the penalty is relative to the size of the action values.
        evidence: page with the runs of these settings; ``None`` for settings without recorded runs
            with this kind of loss.
        tasks: tasks of the runs.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    ramp: float | None = None
    relative: bool = False
    evidence: str | None = None
    tasks: str = ""

    @property
    def shown(self) -> dict[str, Any]:
        """The settings as arguments of ``smooth``, with ``ramp`` and ``relative`` if set."""
        schedule = {} if self.ramp is None else {"ramp": self.ramp}
        return {**self.settings, **schedule, **({"relative": True} if self.relative else {})}

    def overridden(self, overrides: Mapping[str, Any]) -> Preset:
        """Replaces settings, including ``ramp`` and ``relative``.

        Raises:
            TypeError: both a neighborhood and its fields are given.
        """
        settings, overrides = dict(self.settings), dict(overrides)
        ramp = overrides.pop("ramp", self.ramp)
        relative = overrides.pop("relative", self.relative)
        if "neighborhood" in overrides:
            if both := sorted(overrides.keys() & NEIGHBORHOOD_FIELDS):
                raise TypeError(f"Expected a neighborhood or its fields, got both it and {both}.")
            settings = {k: v for k, v in settings.items() if k not in NEIGHBORHOOD_FIELDS}
        return Preset({**settings, **overrides}, ramp, relative, self.evidence, self.tasks)


METHODS = {
    "l2c2": "L2C2Loss",
    "caps": "CAPSLoss",
    "cats": "CATSLoss",
    "grad_caps": "GradCAPSLoss",
    "asap": "ASAPLoss",
    "lcp": "LCPLoss",
    "sr2l": "SR2LLoss",
}
"""The regularizers by the name of the method."""

KINDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "ppo": (
        ("ClipPPOLoss", "ActorCriticLoss"),
        ("PPOLoss", "A2CLoss", "KLPENPPOLoss", "MAPPOLoss", "IPPOLoss"),
    ),
    "sac": (("SACLoss",), ("REDQLoss", "TQCLoss", "CrossQLoss", "CQLLoss")),
    "td3": (("TD3Loss",), ("DDPGLoss",)),
    "ppo_rpe": (("PPORPELoss",), ()),
}
"""Kinds of losses that share presets: the classes used for tuning, and similar classes."""

_PPO_TASKS = "Pendulum, LunarLander, Walker2d and Hopper"

_SR2L = {"coeff": 0.1, "epsilon": 0.05, "steps": 10}


def _for_all(**settings: Any) -> dict[str, Preset]:
    """The same settings for every kind of loss; runs are recorded with PPO."""
    ran = Preset(settings, evidence="results/other_methods.md", tasks="Pendulum and LunarLander")
    return {kind: ran if kind == "ppo" else Preset(settings) for kind in KINDS}


PRESETS: dict[str, dict[str, Preset]] = {
    "l2c2": {
        "ppo": Preset(
            {
                "policy_distance": "mse",
                "neighbors": "line",
                "lambda_min": 1.0,
                "lambda_max": 100.0,
                "beta": 0.0,
            },
            ramp=1.0,
            evidence="results/one_setting.md",
            tasks=_PPO_TASKS,
        ),
        "sac": Preset(
            {
                "policy_distance": "mean",
                "neighbors": "line",
                "lambda_min": 10.0,
                "lambda_max": 1000.0,
                "beta": 0.0,
            },
            ramp=1.0,
            evidence="results/relative.md",
            tasks="Pendulum and LunarLander",
        ),
        "td3": Preset(
            {
                "policy_distance": "mean",
                "neighbors": "line",
                "lambda_min": 0.04,
                "lambda_max": 4.0,
                "beta": 0.0,
            },
            relative=True,
            evidence="results/relative.md",
            tasks="Pendulum and InvertedDoublePendulum",
        ),
        "ppo_rpe": Preset(
            {"lambda_min": 0.01, "lambda_max": 1.0, "beta": 0.1},
            evidence="results/paper.md",
            tasks="Swingup and Reacher",
        ),
    },
    "caps": {
        "ppo": Preset(
            {"sigma": 0.2, "lambda_temporal": 0.01, "lambda_spatial": 0.05},
            evidence="results/one_setting.md",
            tasks=_PPO_TASKS,
        ),
        "sac": Preset(
            {"sigma": 0.2, "lambda_temporal": 1.0, "lambda_spatial": 5.0},
            evidence="results/sac_pendulum.md",
            tasks="Pendulum",
        ),
        "td3": Preset(
            {"sigma": 0.2, "lambda_temporal": 1.0, "lambda_spatial": 5.0},
            evidence="results/td3.md",
            tasks="Pendulum",
        ),
        "ppo_rpe": Preset(
            {"sigma": 0.2, "lambda_temporal": 0.01, "lambda_spatial": 0.05},
            evidence="results/paper.md",
            tasks="Swingup and Reacher",
        ),
    },
    "cats": {
        "ppo": Preset(
            {"lambda_temporal": 0.1},
            ramp=1.0,
            evidence="results/one_setting.md",
            tasks=_PPO_TASKS,
        ),
        "sac": Preset(
            {"lambda_temporal": 10.0},
            ramp=1.0,
            evidence="results/sac_pendulum.md",
            tasks="Pendulum",
        ),
        "td3": Preset(
            {"lambda_temporal": 0.04},
            relative=True,
            evidence="results/relative.md",
            tasks="Pendulum and InvertedDoublePendulum",
        ),
        "ppo_rpe": Preset({"lambda_temporal": 0.1}, ramp=1.0),
    },
    "grad_caps": _for_all(lambda_temporal=0.01, epsilon=0.1),
    "asap": _for_all(lambda_spatial=0.3, lambda_temporal=2.0, lambda_grad=0.05),
    # "mean": a learned deviation would grow, because that lowers the likelihood's gradient or KL.
    "lcp": {
        **_for_all(coeff=0.002, of="mean"),
        "ppo_rpe": Preset({"coeff": 0.002, "of": "log_prob"}),
    },
    "sr2l": {
        **_for_all(**_SR2L, policy_distance="mean"),
        "ppo_rpe": Preset({**_SR2L, "policy_distance": "jeffreys"}),
    },
}
"""The presets, by method and kind of loss."""

GAIN_SETTING = {
    "l2c2": "lambda_min",
    "caps": "lambda_temporal",
    "cats": "lambda_temporal",
    "grad_caps": "lambda_temporal",
    "asap": "lambda_spatial",
    "lcp": "coeff",
    "sr2l": "coeff",
}
"""The setting required if there is no preset, by method."""

# From this multiple of the preset's gain on, a gain is taken for one of an absolute penalty.
_MUCH = 10

# The largest gain of L2C2 that had no measurable effect with these kinds of losses.
_PAPERS_LAMBDA_MAX = 1.0
_WITHOUT_EFFECT = ("ppo", "sac", "td3")


def kind_of(loss_class: type) -> tuple[str | None, bool]:
    """Finds the kind of a loss: the first of its classes in :data:`KINDS`.

    Args:
        loss_class (type): the class of the loss, or a subclass of it.

    Returns:
        tuple: the kind, or ``None``; and whether the presets were tuned with this class.

    Examples:
        >>> from torchrl.objectives import REDQLoss, SACLoss
        >>> from torchrl_l2c2.presets import kind_of
        >>> kind_of(SACLoss), kind_of(REDQLoss), kind_of(dict)
        (('sac', True), ('sac', False), (None, False))
    """
    for part in loss_class.__mro__:
        if not part.__module__.startswith(("torchrl.", "torchrl_l2c2.")):
            continue
        for kind, (exact, similar) in KINDS.items():
            if part.__name__ in exact:
                return kind, True
            if part.__name__ in similar:
                return kind, False
    return None, False


def preset(method: str, kind: str) -> Preset:
    """The settings of a method for a kind of loss.

    Args:
        method (str): one of :data:`METHODS`.
        kind (str): one of :data:`KINDS`.

    Raises:
        ValueError: there is no such method or kind.

    Examples:
        >>> from torchrl_l2c2.presets import preset
        >>> preset("l2c2", "sac").settings["lambda_min"], preset("l2c2", "sac").ramp
        (10.0, 1.0)
    """
    if method not in METHODS:
        raise ValueError(f"Expected method to be one of {list(METHODS)}, got {method!r}.")
    if kind not in KINDS:
        raise ValueError(f"Expected kind to be one of {list(KINDS)}, got {kind!r}.")
    return PRESETS[method][kind]


def mixed_units(method: str, chosen: Preset, gain: float, relative: bool) -> str | None:
    """Says why a gain probably does not suit ``relative``, which gives gains another unit.

    Args:
        method (str): one of :data:`METHODS`.
        chosen (Preset): the preset that the settings replace.
        gain (float): the setting named in :data:`GAIN_SETTING`.
        relative (bool): whether the penalty is relative to the size of the action values.

    Returns:
        str: a clause, or ``None`` if nothing is wrong.

    Examples:
        >>> from torchrl_l2c2.presets import mixed_units, preset
        >>> mixed_units("cats", preset("cats", "td3"), gain=3.0, relative=True)
        "lambda_temporal=3 is 75 times the preset's gain, which is relative to the action values"
    """
    name = GAIN_SETTING[method]
    usual = chosen.settings[name]
    if relative != chosen.relative and gain == usual:
        unit = "relative to the action values" if chosen.relative else "not relative"
        return f"{name}={gain:g} is the preset's gain, which is {unit}"
    if relative and chosen.relative and gain > _MUCH * usual:
        times = f"{gain / usual:.0f} times the preset's gain"
        return f"{name}={gain:g} is {times}, which is relative to the action values"
    return None


def without_effect(loss_class: type, lambda_max: float) -> bool:
    """Checks whether such small gains of L2C2 had no measurable effect with such losses."""
    kind, _ = kind_of(loss_class)
    return kind in _WITHOUT_EFFECT and lambda_max <= _PAPERS_LAMBDA_MAX
