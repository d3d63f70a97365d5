"""Names and colors of methods in tables and pictures, and their order."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS, L2C2Config

# In the order of tables: name and color.
METHODS = {
    "none": ("baseline", "#777777"),
    "caps": ("CAPS", "#d95f02"),
    "l2c2": ("L2C2", "#1b6ca8"),
    "l2c2_paper": ("L2C2 as in the paper", "#6fa8dc"),
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

NAMES = (
    "Names of L2C2: the distance of policies (`policy_distance`; *means*: `mean`), the gain "
    "(`lambda_min`), and *ramp* if the gain rises over training."
)
"""Note on names with settings."""


def method_name(method: str) -> str:
    """Returns the name of a method in tables and pictures."""
    return METHODS.get(method, (method, ""))[0]


def method_order(method: str) -> tuple[int, str]:
    """Sort key of methods: the order of ``METHODS``, then other methods by name."""
    known = list(METHODS)
    return (known.index(method) if method in known else len(known), method)


def name_with_settings(method: str, settings: Mapping[str, str]) -> tuple[str, set[str]]:
    """Name of a method with its own settings, and the settings that the name contains.

    The name of L2C2 contains its distance and its gain, or the target of the gain. "L2C2" without
    them has the Hellinger distance and the gains of the paper. Every name contains a strength other
    than 1, and whether the penalty is relative. The constant gain of a relative penalty is not in
    the name.

    Args:
        method (str): The method's name.
        settings (Mapping): Settings that differ from the defaults, as in records.

    Examples:
        >>> name_with_settings("l2c2", {"regularizer.beta": "0.5"})
        ('L2C2', set())
        >>> own = {"regularizer.policy_distance": "mse", "regularizer.lambda_min": "0.3"}
        >>> name_with_settings("l2c2_ramp", own)[0]
        'L2C2, mse 0.3, ramp'
        >>> own |= {"regularizer.gain": "target", "regularizer.gain_target": "0.1"}
        >>> name_with_settings("l2c2", own)[0]
        'L2C2, mse, target 0.1'
        >>> name_with_settings("cats", {"regularizer.strength": "0.25"})[0]
        'CATS, strength=0.25'
        >>> own = {"regularizer.relative": "true", "regularizer.gain": "constant"}
        >>> name_with_settings("cats", own)[0]
        'CATS, relative'
    """
    own = {name.removeprefix("regularizer."): value for name, value in settings.items()}
    name, contained = _name_with_gains(method, own)
    if own.get("relative") == "true":
        name += ", relative"
        contained.add("relative")
        if own.get("gain") == "constant":
            contained.add("gain")
    strength = float(own.get("strength", 1.0))
    if strength != 1.0:
        name += f", strength={strength:g}"
        contained.add("strength")
    return name, {f"regularizer.{setting}" for setting in contained}


def _name_with_gains(method: str, own: Mapping[str, str]) -> tuple[str, set[str]]:
    usual = REGULARIZERS.get(method)
    if not isinstance(usual, L2C2Config) or not {"policy_distance", "lambda_min"} & own.keys():
        return method_name(method), set()
    distance = DISTANCES[own.get("policy_distance", usual.policy_distance)]
    gain, smallest = own.get("gain", usual.gain), own.get("lambda_min", f"{usual.lambda_min:g}")
    contained = {"policy_distance", "gain"}
    if gain == "target":
        contained.add("gain_target")
        name = f"{distance}, {gain} {own.get('gain_target')}"
    else:
        contained.add("lambda_min")
        name = f"{distance} {smallest}{', ramp' if gain == 'ramp' else ''}"
        ratio = float(own.get("lambda_max", usual.lambda_max)) / float(smallest)
        # The paper's ratio is not part of a name.
        if math.isclose(ratio, usual.lambda_max / usual.lambda_min):
            contained.add("lambda_max")
    return f"L2C2, {name}", contained
