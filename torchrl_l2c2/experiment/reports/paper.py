"""The paper's own results, and how its methods are named and colored."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from torchrl_l2c2.experiment.regularizers import REGULARIZERS, L2C2Config


class Published(NamedTuple):
    """Mean and (over 18 seeds) standard deviation of a cell of the paper's Table III."""

    return_mean: float
    return_std: float
    action_variation_mean: float
    action_variation_std: float

    def cell(self, quantity: str) -> tuple[float, float]:
        """Mean and standard deviation of a quantity, such as ``"return"``."""
        return getattr(self, f"{quantity}_mean"), getattr(self, f"{quantity}_std")


# Kobayashi (2022), Table III: return and L2 norm of temporal actions.
PAPER: dict[tuple[str, str], Published] = {
    ("swingup", "none"): Published(649.57, 77.96, 0.084, 0.011),
    ("reacher", "none"): Published(14.73, 4.34, 0.132, 0.032),
    ("hopper", "none"): Published(1561.85, 879.99, 0.157, 0.097),
    ("ant", "none"): Published(2724.32, 341.46, 0.635, 0.090),
    ("swingup", "caps"): Published(239.57, 26.56, 0.026, 0.002),
    ("reacher", "caps"): Published(-1.57, 1.53, 0.003, 0.001),
    ("hopper", "caps"): Published(762.20, 321.26, 0.004, 0.001),
    ("ant", "caps"): Published(911.36, 98.33, 0.002, 0.001),
    ("swingup", "l2c2"): Published(693.77, 123.78, 0.075, 0.012),
    ("reacher", "l2c2"): Published(15.42, 4.04, 0.096, 0.018),
    ("hopper", "l2c2"): Published(2091.76, 563.82, 0.174, 0.055),
    ("ant", "l2c2"): Published(2762.75, 536.85, 0.531, 0.150),
    ("swingup", "l2c2_policy"): Published(707.41, 40.94, 0.075, 0.010),
    ("reacher", "l2c2_policy"): Published(15.81, 4.196, 0.095, 0.023),
    ("hopper", "l2c2_policy"): Published(1998.54, 714.88, 0.141, 0.063),
    ("ant", "l2c2_policy"): Published(2690.26, 483.62, 0.521, 0.142),
}
# Section V: what L2C2 on Swingup returned with faster target networks, at this tau instead of .1.
TAU, FASTER = "algorithm.tau", 0.5
FASTER_RETURNS = {"l2c2": 376.0, "l2c2_policy": 284.0}
METHODS = {
    "none": ("vanilla", "#777777"),
    "caps": ("CAPS", "#d95f02"),
    "l2c2": ("L2C2", "#1b6ca8"),
    "l2c2_paper": ("L2C2, the paper's", "#6fa8dc"),
    "l2c2_policy": ("L2C2, beta=0", "#7570b3"),
    "l2c2_mean": ("L2C2, means", "#2a9d8f"),
    "l2c2_ramp": ("L2C2, means, ramp", "#0b3d66"),
    "l2c2_constant": ("L2C2, constant", "#1b6ca8"),
    "cats": ("CATS", "#b0416b"),
    "grad_caps": ("Grad-CAPS", "#8a6d1d"),
    "asap": ("ASAP", "#4b6f44"),
    "sr2l": ("SR2L", "#444444"),
    "lcp": ("LCP", "#9c755f"),
}

DISTANCES = {"hellinger": "Hellinger", "mean": "means", "mse": "mse", "kl": "KL"}


def method_name(method: str) -> str:
    """How a method is called in tables and pictures; its own name where the paper has none."""
    return METHODS.get(method, (method, ""))[0]


def name_with_settings(method: str, settings: Mapping[str, str | None]) -> tuple[str, set[str]]:
    """How a method is called with settings of its own, and which of them the name tells.

    L2C2 is told by its distance and its gain, or what this follows: by itself it is the paper's,
    with Hellinger's and the paper's gains, whatever else it may be elsewhere.

    Args:
        method (str): its name.
        settings (Mapping): what differs from its defaults, as records have it.

    Examples:
        >>> name_with_settings("l2c2", {"regularizer.beta": "0.5"})
        ('L2C2', set())
        >>> own = {"regularizer.policy_distance": "mse", "regularizer.lambda_min": "0.3"}
        >>> name_with_settings("l2c2_ramp", own)[0]
        'L2C2, mse 0.3, ramp'
        >>> own |= {"regularizer.gain": "target", "regularizer.gain_target": "0.1"}
        >>> name_with_settings("l2c2", own)[0]
        'L2C2, mse, target 0.1'
    """
    usual = REGULARIZERS.get(method)
    own = {k.removeprefix("regularizer."): v for k, v in settings.items() if v is not None}
    if not isinstance(usual, L2C2Config) or not {"policy_distance", "lambda_min"} & own.keys():
        return method_name(method), set()
    distance = DISTANCES[own.get("policy_distance", usual.policy_distance)]
    gain, edge = own.get("gain", usual.gain), own.get("lambda_min", f"{usual.lambda_min:g}")
    told = {"policy_distance", "gain"}
    if gain in ("target", "gradient"):
        told, name = told | {"gain_target"}, f"{distance}, {gain} {own.get('gain_target')}"
    else:
        told, name = told | {"lambda_min"}, f"{distance} {edge}{', ramp' if gain == 'ramp' else ''}"
        ratio = float(own.get("lambda_max", usual.lambda_max)) / float(edge)
        if math.isclose(ratio, usual.lambda_max / usual.lambda_min):
            told.add("lambda_max")  # The paper's ratio goes without saying.
    return f"L2C2, {name}", {f"regularizer.{setting}" for setting in told}


def method_order(method: str) -> tuple[int, str]:
    """Sorts the paper's methods as the paper does, others behind them by name."""
    known = list(METHODS)
    return (known.index(method) if method in known else len(known), method)


def paper_of(task: str, algorithm: str, method: str) -> Published | None:
    """The paper's results of a task and a method, with its algorithm; ``None`` for all others."""
    return PAPER.get((task, method)) if is_of_paper(task, algorithm) else None


def is_of_paper(task: str, algorithm: str) -> bool:
    """Whether it is one of the paper's tasks with its algorithm, by whatever method."""
    return algorithm == "ppo_rpe" and (task, "none") in PAPER
