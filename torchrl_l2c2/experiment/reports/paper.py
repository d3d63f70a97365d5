"""The paper's own results, and which runs they are beside."""

from __future__ import annotations

from typing import NamedTuple


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


def paper_of(task: str, algorithm: str, method: str) -> Published | None:
    """The paper's results of a task and a method, with its algorithm; ``None`` for all others."""
    return PAPER.get((task, method)) if is_of_paper(task, algorithm) else None


def is_of_paper(task: str, algorithm: str) -> bool:
    """Whether it is one of the paper's tasks with its algorithm, by whatever method."""
    return algorithm == "ppo_rpe" and (task, "none") in PAPER
