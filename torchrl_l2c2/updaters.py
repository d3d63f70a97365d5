"""The t-soft update: target networks that follow their sources robustly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_l2c2._checks import check_real

INITIAL_SCALE = 1e-8
# Squared distances below this are under the resolution of float32 weights. The floor is met only
# where source and target stay equal: there the scale would decay to 0, and 0 / 0 is NaN.
SCALE_FLOOR = 1e-16
# Below it, the weight of a source equal to its target comes near float32's largest number.
SMALLEST_NU = 1e-30


class TSoftUpdate(TargetNetUpdater):
    r"""Moves target parameters towards their sources, less after a jump of the sources.

    The update is a running mean under a Student's t-distribution. A source much further from its
    target than usual counts as an outlier and gets a small weight (Kobayashi and
    Ilboudo, "t-soft update of target network for deep reinforcement learning", 2021; the paper's
    target update). For each parameter tensor :math:`\theta` with target :math:`\bar\theta`:

    .. math::
        D^2 &= \mathrm{mean}\big((\bar\theta - \theta)^2\big), \quad
        w = \frac{\nu + 1}{\nu + D^2 / s^2}, \quad
        \tau_i = \frac{w}{W + w} \\
        \bar\theta &\leftarrow \bar\theta + \tau_i (\theta - \bar\theta) \\
        s^2 &\leftarrow s^2 + \tau w \frac{\nu}{\nu + 1} (D^2 - s^2), \quad
        W \leftarrow (1 - \tau) (W + w)

    starting from :math:`\bar\theta = \theta`, :math:`W = (1 - \tau) / \tau` and
    :math:`s^2 = 10^{-8}`. At :math:`w = 1` it is the ordinary soft update,
    :math:`\tau_i = \tau`.

    There is one set of statistics for each tensor as it is stored: the copies of an ensemble's
    parameter (the leading dimension that, for example, ``SACLoss`` gives its critics) share one.
    Parameters whose target is not distinct stay as they are, as with every TorchRL updater.

    Args:
        loss_module (LossModule): the loss whose ``target_*_params`` are to follow.
        tau (float): pace, in ``(0, 1]``. Larger values make targets follow more closely; at 1 they
            become their sources. Default 0.1.
        nu (float): degrees of freedom, at least 1e-30. Smaller values hold back more against jumps;
            ``math.inf`` gives the ordinary soft update. Default 1.0.

    Raises:
        TypeError: a setting that is not a real number.
        ValueError: a setting outside its range, or ``loss_module`` is not a loss module.
        RuntimeError: the loss has no target parameters of its own.

    .. note:: Where a source and its target stay equal, :math:`s^2` is kept at ``1e-16`` or above;
        the recursion itself would run into 0 / 0 after some hundred steps [inferred]. Such a
        target needs about a hundred steps until it follows again.

    .. note:: :meth:`state_dict` holds the statistics; the targets themselves are a part of the
        loss's. :meth:`step` can be a part of a compiled function.

    Examples:
        >>> import torch
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import TSoftUpdate
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = DDPGLoss(Actor(torch.nn.Linear(3, 1)), value, delay_value=True)
        >>> updater = TSoftUpdate(loss, tau=0.1, nu=1.0)
        >>> weight = loss.value_network_params["module", "bias"]
        >>> target = loss.target_value_network_params["module", "bias"]
        >>> _ = weight.data.add_(1.0)
        >>> updater.step()  # a jump: w = 2e-8 instead of 1
        >>> bool((weight - target).item() > 0.999)
        True
    """

    def __init__(self, loss_module: LossModule, tau: float = 0.1, nu: float = 1.0) -> None:
        check_real("TSoftUpdate: tau", tau, above=0, at_most=1)
        hint = "math.inf gives the ordinary soft update."
        check_real("TSoftUpdate: nu", nu, at_least=SMALLEST_NU, finite=False, hint=hint)
        self.tau = tau
        self.nu = nu
        super().__init__(loss_module)

    def init_(self) -> None:
        """Sets the targets to their sources and the statistics to their start."""
        super().init_()
        # One name and one tensor per parameter: tensordicts are slow to walk at every step.
        sources, targets = self._sources.flatten_keys("."), self._targets.flatten_keys(".")
        self._names = list(sources.keys())
        self._source_list = [sources[name] for name in self._names]
        self._target_list = [targets[f"target_{name}"] for name in self._names]
        first, start = self._target_list[0], (1.0 - self.tau) / self.tau
        self._weight = first.new_full((len(self._names),), start, dtype=_precise(first))
        self._scale = torch.full_like(self._weight, INITIAL_SCALE)

    @torch.no_grad()
    def step(self) -> None:
        """Updates all targets and the statistics, in place."""
        self._follow_loss_module()
        t_soft_update(
            [target.data for target in self._target_list],
            [source.data for source in self._source_list],
            self._weight,
            self._scale,
            tau=self.tau,
            nu=self.nu,
        )

    def state_dict(self) -> dict[str, Any]:
        """The base's progress and the statistics of every tensor, by its name."""
        return {
            **super().state_dict(),
            "weight": dict(zip(self._names, self._weight.clone(), strict=True)),
            "scale": dict(zip(self._names, self._scale.clone(), strict=True)),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores the result of :meth:`state_dict`.

        Args:
            state_dict (Mapping): state of an updater of a loss with the same parameters.

        Raises:
            KeyError: statistics are missing, or belong to other parameters.
        """
        for entry in ("weight", "scale"):
            saved = state_dict.get(entry, {})
            missing = [name for name in self._names if name not in saved]
            unexpected = [name for name in saved if name not in self._names]
            if missing or unexpected:
                raise KeyError(
                    f"TSoftUpdate: the state's {entry!r} does not fit the loss: missing {missing}, "
                    f"unexpected {unexpected}. Load the state of an updater of the same networks."
                )
        super().load_state_dict(state_dict)
        # In place: a state may come from another device or dtype.
        for entry, vector in (("weight", self._weight), ("scale", self._scale)):
            vector.copy_(torch.stack([state_dict[entry][name] for name in self._names]))

    def _follow_loss_module(self) -> None:
        """Moves the statistics to the device and dtype of the loss."""
        target = self._target_list[0]
        place = target.device, _precise(target)
        if (self._weight.device, self._weight.dtype) != place:
            self._weight, self._scale = self._weight.to(*place), self._scale.to(*place)


def _precise(target: Tensor) -> torch.dtype:
    """The statistics' dtype: squared distances of weights would be 0 in half precision."""
    return torch.promote_types(target.dtype, torch.float32)


def t_soft_update(
    targets: list[Tensor],
    sources: list[Tensor],
    weight: Tensor,
    scale: Tensor,
    *,
    tau: float,
    nu: float,
) -> None:
    """Functional form of :class:`TSoftUpdate`: updates targets and statistics in place.

    Args:
        targets (list of Tensor): ``N`` target parameters of one dtype, on one device.
        sources (list of Tensor): the parameters that they follow.
        weight (Tensor): accumulated weights :math:`W`, shape ``[N]``, in float32 or better.
        scale (Tensor): squared scales :math:`s^2`, shape ``[N]``, in float32 or better.

    Keyword Args:
        tau (float): pace.
        nu (float): degrees of freedom.
    """
    # In terms of 1 / nu: nu = inf then needs no special case.
    rate = 0.0 if math.isinf(nu) else 1.0 / nu
    differences = torch._foreach_sub(sources, targets)
    wide = [difference.to(scale.dtype) for difference in differences]
    squares = torch._foreach_mul(wide, wide)
    distance = torch.stack([square.mean() for square in squares])
    w = (1.0 + rate) / (1.0 + rate * distance / scale)
    pace = w / (weight + w)
    torch._foreach_addcmul_(targets, differences, pace.to(differences[0].dtype).unbind())
    scale.add_(tau / (1.0 + rate) * w * (distance - scale)).clamp_min_(SCALE_FLOOR)
    weight.add_(w).mul_(1.0 - tau)
