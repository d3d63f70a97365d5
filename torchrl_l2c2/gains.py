r"""A gain that meets a target, and the size of a regularizer's gradients.

The gain is for the factor of a regularized loss. Assign it between updates, also if the loss is
compiled::

    loss.regularizer_gain = gain.step(measured)

A gain that rises with the progress of training is part of the loss: ``loss.ramp()`` and
``loss.set_progress(...)``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import deepcopy
from numbers import Real
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.linalg import vector_norm
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import as_number, check_real, check_takes_gradients
from torchrl_l2c2._warnings import warn


class TargetGain:
    r"""A gain that rises while a measure is above its target, and falls while it is below.

    .. math::
        \ln\lambda \leftarrow \ln\lambda
            + \eta\, \mathrm{clip}\left(\frac{m - x}{x}, -1, 1\right)

    This is dual ascent on the constraint :math:`m \le x`, on the gain's logarithm, within bounds.
    SAC sets its temperature in the same way. :math:`m` is the measure that the term lowers, such as
    the variation of the actions in an episode.

    Args:
        target (float): :math:`x`, the largest value wanted, greater than 0. Smaller values
            regularize more.
        rate (float): :math:`\eta`, in (0, 1]: the largest change of the logarithm in a step.
            Larger values reach the target sooner, and overshoot. Defaults to ``0.1``.
        limit (float): the gain stays between ``value / limit`` and ``value * limit``, greater
            than 1. At the upper bound the target is out of reach. Defaults to ``1000``.
        value (float): the first gain, greater than 0. Defaults to ``1.0``.

    Raises:
        TypeError: if a value is not a real number.
        ValueError: if it is out of its range.

    Examples:
        >>> from torchrl_l2c2.gains import TargetGain
        >>> gain = TargetGain(0.5)
        >>> round(gain.step(0.75), 4), round(gain.step(0.25), 4)
        (1.0513, 1.0)
    """

    def __init__(
        self, target: float, rate: float = 0.1, limit: float = 1000.0, value: float = 1.0
    ) -> None:
        check_real("target", target, above=0)
        check_real("rate", rate, above=0, at_most=1)
        check_real("value", value, above=0)
        check_real("limit", limit, above=1)
        self.value = self._first = float(value)
        self.target = float(target)
        self.rate = float(rate)
        self.limit = float(limit)

    def step(self, measured: float) -> float:
        """The next value after a measure :math:`m`; NaN and infinity change nothing.

        Raises:
            TypeError: it is no number.
        """
        measured = _measured(measured)
        if math.isfinite(measured):
            excess = min(max(measured / self.target - 1.0, -1.0), 1.0)
            value = self.value * math.exp(self.rate * excess)
            self.value = min(max(value, self._first / self.limit), self._first * self.limit)
        return self.value

    def state_dict(self) -> dict[str, float]:
        """The value, which the next steps depend on."""
        return {"value": self.value}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restores the result of :meth:`state_dict`; set the loss's gain to ``value`` then.

        Raises:
            ValueError: there are other entries, or the value is out of its range; nothing is
                changed.
        """
        if state.keys() != self.state_dict().keys():
            raise ValueError(
                f"Expected the state of a gain, with {list(self.state_dict())}, got {list(state)}."
            )
        lowest, highest = self._first / self.limit, self._first * self.limit
        check_real("value", state["value"], at_least=lowest, at_most=highest)
        self.value = state["value"]


def _measured(measured: Any) -> float:
    """A number, which need not be finite."""
    measured = as_number("measured", measured)
    if not isinstance(measured, Real) or isinstance(measured, bool):
        raise TypeError(f"measured must be a real number, got {measured!r}.")
    return float(measured)


# CQL minimizes its cloning term instead of the actor's term, never both.
ALTERNATIVE_LOSSES = ("loss_actor_bc",)


def is_loss(key: str) -> bool:
    """Tells if an entry of a loss's output is a term of the sum."""
    return key == "loss" or key.startswith("loss_")


@torch.enable_grad()
def gradient_shares(loss: LossModule, batch: TensorDictBase) -> dict[str, float]:
    r"""Gradient norms of a regularizer's terms, relative to the loss's own gradient.

    .. math::
        \frac{\lVert \nabla_\theta L_r \rVert_2}{\lVert \nabla_\theta L \rVert_2}

    for every term :math:`L_r` that a regularizer adds to a loss :math:`L`, in the parameters
    :math:`\theta` that the term trains. The term may be separate or folded into the loss's own
    terms. The loss does not change, and nothing is drawn from torch's global generators.

    Args:
        loss (LossModule): the loss in training, with a regularizer.
        batch (TensorDictBase): the loss's input; not written to.

    Returns:
        dict: at least 0 for every added ``loss_*`` key; infinite if the loss's own gradient is zero
        and the term's is not, 0 for a term that trains nothing, as with frozen networks.

    Warns:
        UserWarning: the loss was called in training, and a term was never differentiated: the
            training loop does not add it, whatever its share is here.

    Raises:
        TypeError: the loss has no regularizer.
        ValueError: a term is not a single number.
        RuntimeError: in inference mode, which keeps no gradients.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP, Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import CATSLoss
        >>> from torchrl_l2c2.gains import gradient_shares
        >>> _ = torch.manual_seed(0)
        >>> critic = ValueOperator(MLP(4, 1), in_keys=["observation", "action"])
        >>> loss = CATSLoss(DDPGLoss(Actor(torch.nn.Linear(3, 1)), critic), lambda_temporal=0.5)
        >>> flags = torch.zeros(8, 1, dtype=torch.bool)
        >>> then = {"observation": torch.randn(8, 3), "reward": torch.randn(8, 1)}
        >>> now = {"observation": torch.randn(8, 3), "action": torch.randn(8, 1)}
        >>> batch = TensorDict({**now, "next": {**then, "done": flags, "terminated": flags}}, [8])
        >>> share = gradient_shares(loss, batch)["loss_cats"]
        >>> loss.regularizer_gain = 2.0
        >>> round(gradient_shares(loss, batch)["loss_cats"] / share, 3)
        2.0
    """
    if not hasattr(loss, "added_terms"):
        raise TypeError(
            f"gradient_shares takes a loss with a regularizer, and this {type(loss).__name__} has "
            "none: assign the result of smooth, loss = smooth(loss)."
        )
    names = loss.added_terms
    if not names:
        return {}
    check_takes_gradients("gradient_shares")
    if hasattr(loss, "_watch") and (unused := loss._watch.unused()):
        warn(
            f"{sorted(unused)} were never differentiated: the training loop does not add them to "
            "the loss that is minimized. Add them, or call loss.fold() after making it."
        )
    # A copy, because some losses keep statistics of their batches.
    devices = {parameter.device for parameter in loss.parameters() if parameter.is_cuda}
    with torch.random.fork_rng(devices=devices):
        twin = deepcopy(loss)
        twin.reset_out_keys()  # All terms are needed, also if only some were selected.
        if getattr(twin, "folded", False):
            twin.unfold()
        terms = twin(batch.copy())
    if any(terms[key].ndim for key in terms.keys() if is_loss(key)):
        raise ValueError(
            "gradient_shares needs terms that are single numbers, one for the whole batch: make "
            "the loss with reduction='mean'."
        )
    added = [key for key in twin.out_keys if key in names]
    parameters = [parameter for parameter in twin.parameters() if parameter.requires_grad]

    def gradients(value: Tensor) -> tuple[Tensor | None, ...]:
        if not value.requires_grad:  # It trains only frozen parameters.
            return (None,) * len(parameters)
        return torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)

    others = (*added, *ALTERNATIVE_LOSSES)
    losses = (terms[key] for key in terms.keys() if is_loss(key) and key not in others)
    own = gradients(sum(losses, torch.zeros(())))  # A loss may have no own terms, as in rsl_rl.
    shares = {}
    for key in added:
        pairs = [(g, o) for g, o in zip(gradients(terms[key]), own, strict=True) if g is not None]
        norm, own_norm = (_norm(pair[side] for pair in pairs) for side in (0, 1))
        shares[key] = norm / own_norm if own_norm else math.inf if norm else 0.0
    return shares


def _norm(gradients: Iterable[Tensor | None]) -> float:
    # Squares of small gradients would be 0 in half precision.
    return math.hypot(*(float(vector_norm(g)) for g in gradients if g is not None))
