"""AdaTerm, an optimizer whose moments withstand outlier gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from torchrl_l2c2._checks import check_real

TINY = torch.finfo(torch.float32).tiny
SUPPORTED_DTYPES = (torch.float32, torch.float64)
SETTINGS = {"lr", "beta", "eps", "nu_min"}
OF_OTHERS = {"amsgrad", "betas", "maximize", "momentum", "nesterov", "weight_decay"}
"""Settings of torch's optimizers that AdaTerm does not have."""


class AdaTerm(Optimizer):
    r"""Adaptive moments estimated by a Student's t-distribution (AdaTerm).

    The gradients :math:`g` of each parameter tensor are modelled by a t-distribution with location
    :math:`m`, squared scale :math:`v` and degrees of freedom :math:`\nu`. A gradient far from the
    previous gradients gets a small weight :math:`w`, and :math:`\nu` adapts to how often that
    happens. With one scalar :math:`D, w, \nu` per tensor and the right-hand sides at their old
    values (Ilboudo, Kobayashi and Matsubara, "AdaTerm: Adaptive T-Distribution Estimated Robust
    Moments for Noise-Robust Stochastic Gradient Optimization", 2022; the paper's optimizer):

    .. math::
        s &= (g - m)^2, \quad D = \mathrm{mean}(s / v), \quad
        w = \frac{\nu + 1}{\nu + D}, \quad \bar w = \frac{\nu + 1}{\nu} \\
        m &\leftarrow m + \tau (g - m), \quad \tau = (1 - \beta)\, w / \bar w \\
        v &\leftarrow v + \tau \big(s + \max(\epsilon^2, (s - D v) / \nu) - v\big) \\
        \nu &\leftarrow \nu + (1 - \beta) \frac{\tilde w}{\bar{\tilde w}} (\lambda - \nu), \quad
        \tilde w = w - \ln w, \quad
        \bar{\tilde w} = \max(\bar w - \ln \bar w, -\ln \mathrm{tiny}) \\
        \lambda &= \Big(\frac{\nu + 2}{\nu + 1} + \nu\Big) \frac{1}{\tilde w}
        \Big(1 - \frac{\nu_{\min}}{\nu}\Big) + \nu_{\min} + \epsilon \\
        \theta &\leftarrow \theta - \mathrm{lr} \cdot
        \frac{m / (1 - \beta^t)}{\sqrt{v / (1 - \beta^t)}}

    starting from :math:`m = 0`, :math:`v = \epsilon^2` and :math:`\nu = \nu_{\min} + \epsilon`.

    .. note:: **Precision.** :math:`\nu` has the parameters' precision, as in the optimizer that its
        authors released. Near its start it changes by less than float32 resolves: with the default
        settings it then stays there, the most robust of optimizers. In float64 it grows with
        gradients that hold no outliers, over some thousand steps.

    Args:
        params (iterable): parameters, named parameters or parameter groups, in float32 or float64.
        lr (float or Tensor): learning rate, at least 0: a step is this many times the ratio of a
            gradient's mean to its deviation. Default 1e-3.
        beta (float): decay of the moments, in ``(0, 1)``. Larger values average over more
            gradients: steadier and slower to follow a change. Default 0.9.
        eps (float): smallest scale of a gradient's deviation, above 0. Larger values limit the
            steps where gradients hardly vary (to ``lr * |g| / eps``: so much that losses whose
            gradients are below it hardly learn) and shorten the warm-up; smaller ones do the
            opposite. Default 1e-5.
        nu_min (float): lowest degrees of freedom, above 0. Smaller values discard outliers more
            strongly; towards infinity none is discarded. Default 1.0.

    Raises:
        TypeError: a parameter is neither float32 nor float64: squared scales as small as ``eps**2``
            do not fit into half precision; or a setting is not a real number.
        ValueError: a setting outside its range.

    .. note:: **Warm-up.** Scales start at ``eps``, so the first gradients of usual size look like
        outliers and get next to no weight. The moments grow to the gradients' size within about
        ``2 ln(|g| / eps) / (1 - beta)`` steps: some 80 with the default values and gradients of
        1e-3, some 120 with gradients of 1e-2.

    .. note:: **Gradients that are not finite** make the parameter and its moments NaN, as with
        :class:`torch.optim.Adam`: nothing is hidden. Finite ones, however large, do not, as long
        as their squares are finite.

    .. note:: **Compilation.** The state is allocated at construction and nothing is read back from
        the device. Therefore :meth:`step` can be a part of a function compiled with
        ``torch.compile(fullgraph=True)`` without recompiling from step to step. A scheduled
        learning rate also takes effect there. As a float, its first change recompiles once; as
        ``lr=torch.tensor(1e-3)``, no change does. Move a model to its device before
        constructing the optimizer.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2 import AdaTerm
        >>> x = torch.nn.Parameter(torch.tensor([3.0, -2.0]))
        >>> optimizer = AdaTerm([x], lr=0.05)
        >>> for _ in range(500):
        ...     loss = x.square().sum()
        ...     optimizer.zero_grad()
        ...     loss.backward()
        ...     optimizer.step()
        >>> bool(loss < 1e-2)
        True
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float | Tensor = 1e-3,
        beta: float = 0.9,
        eps: float = 1e-5,
        nu_min: float = 1.0,
    ) -> None:
        # "capturable" is read by torch's own machinery: the step count lives where the parameters
        # live, and stays there when a state is loaded.
        defaults = {"lr": lr, "beta": beta, "eps": eps, "nu_min": nu_min, "capturable": True}
        super().__init__(params, defaults)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Adds a group of parameters, with the constructor's settings where it has none.

        Args:
            param_group (dict): ``params`` and, where they differ, ``lr``, ``beta``, ``eps`` and
                ``nu_min``.

        Raises:
            TypeError: a parameter is neither float32 nor float64, a setting is no real number, or
                it belongs to another optimizer, such as ``weight_decay``.
            ValueError: a setting outside its range.
        """
        if foreign := sorted(key for key in OF_OTHERS if param_group.get(key)):
            raise TypeError(
                f"AdaTerm: the settings of a group are {sorted(SETTINGS)}, got {foreign}, which "
                "would have no effect: leave it out."
            )
        _check_settings({**self.defaults, **param_group})
        super().add_param_group(param_group)
        group = self.param_groups[-1]
        for p in group["params"]:
            if p.dtype not in SUPPORTED_DTYPES:
                self.param_groups.pop()
                raise TypeError(
                    f"AdaTerm: parameters must be float32 or float64, got {p.dtype}: keep them "
                    "in float32 and compute in lower precision with torch.autocast."
                )
        # At the first step it would cost a compiled update a second graph.
        for p in group["params"]:
            self.state[p] = {
                "step": torch.zeros((), dtype=torch.float32, device=p.device),
                "exp_avg": torch.zeros_like(p, memory_format=torch.preserve_format),
                "exp_avg_var": torch.full_like(p, group["eps"] ** 2),
                "nu": torch.full(
                    (), group["nu_min"] + group["eps"], dtype=p.dtype, device=p.device
                ),
            }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the result of ``state_dict``.

        Args:
            state_dict (dict): state of an AdaTerm with parameters of the same number and shapes.

        Raises:
            ValueError: the state belongs to another optimizer or to other parameters; nothing is
                changed.
        """
        for group in state_dict["param_groups"]:
            if missing := SETTINGS - group.keys():
                raise ValueError(
                    f"AdaTerm: the state has no {sorted(missing)}, but {sorted(group)}: it is "
                    "another optimizer's. Begin with a new AdaTerm."
                )
        parameters = [p for group in self.param_groups for p in group["params"]]
        saved = {n: entry["exp_avg"].shape for n, entry in state_dict["state"].items()}
        for number, p in enumerate(parameters):
            if saved.get(number, p.shape) != p.shape:
                raise ValueError(
                    f"AdaTerm: parameter {number} of the state has the shape "
                    f"{tuple(saved[number])}, got one of {tuple(p.shape)}: it is of other "
                    "parameters. Begin with a new AdaTerm."
                )
        super().load_state_dict(state_dict)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Performs one step; parameters without a gradient keep their value and their state.

        Args:
            closure (callable, optional): reevaluates the model and returns the loss.

        Returns:
            What the closure returned, or ``None``.

        Raises:
            RuntimeError: a gradient is sparse.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for params, grads in _alike(group["params"]):
                states = [self.state[p] for p in params]
                adaterm(
                    params,
                    grads,
                    [state["exp_avg"] for state in states],
                    [state["exp_avg_var"] for state in states],
                    [state["nu"] for state in states],
                    [state["step"] for state in states],
                    lr=group["lr"],
                    beta=group["beta"],
                    eps=group["eps"],
                    nu_min=group["nu_min"],
                )
        return loss


def adaterm(
    params: list[Tensor],
    grads: list[Tensor],
    exp_avgs: list[Tensor],
    exp_avg_vars: list[Tensor],
    nus: list[Tensor],
    state_steps: list[Tensor],
    *,
    lr: float | Tensor,
    beta: float,
    eps: float,
    nu_min: float,
) -> None:
    r"""Functional form of :class:`AdaTerm`: updates parameters and state in place.

    It processes the elements of all tensors list by list, and the scalars of all tensors as one
    vector.

    Args:
        params (list of Tensor): ``N`` parameters of one dtype, on one device.
        grads (list of Tensor): their gradients.
        exp_avgs (list of Tensor): locations :math:`m`.
        exp_avg_vars (list of Tensor): squared scales :math:`v`.
        nus (list of Tensor): degrees of freedom, each of shape ``[]``.
        state_steps (list of Tensor): how many steps were taken, each of shape ``[]``.

    Keyword Args:
        lr (float or Tensor): learning rate.
        beta (float): decay of the moments.
        eps (float): smallest scale of a gradient's deviation.
        nu_min (float): lowest degrees of freedom.
    """
    deviations = torch._foreach_sub(grads, exp_avgs)
    squares = torch._foreach_mul(deviations, deviations)
    # One by one: _foreach_norm(..., 1) is slower, by far when compiled for the CPU.
    means = [quotient.mean() for quotient in torch._foreach_div(squares, exp_avg_vars)]
    nu, mean_distance = torch.stack(nus), torch.stack(means)
    tau = (1.0 - beta) * nu / (nu + mean_distance)

    # s + max(eps^2, (s - D v) / nu) - v
    changes = torch._foreach_addcmul(squares, exp_avg_vars, (-mean_distance).unbind())
    torch._foreach_div_(changes, nu.unbind())
    torch._foreach_clamp_min_(changes, eps**2)
    torch._foreach_add_(changes, squares)
    torch._foreach_sub_(changes, exp_avg_vars)

    torch._foreach_addcmul_(exp_avgs, deviations, tau.unbind())
    torch._foreach_addcmul_(exp_avg_vars, changes, tau.unbind())
    torch._foreach_copy_(nus, _next_nu(nu, mean_distance, beta, eps, nu_min).unbind())
    step = torch.stack(state_steps) + 1.0
    torch._foreach_copy_(state_steps, step.unbind())

    # m / (1 - beta^t) over the root of v / (1 - beta^t).
    step_size = lr / (1.0 - beta ** step.to(nu.dtype)).sqrt()
    directions = torch._foreach_rsqrt(exp_avg_vars)
    torch._foreach_mul_(directions, exp_avgs)
    torch._foreach_addcmul_(params, directions, (-step_size).unbind())


def _next_nu(nu: Tensor, mean_distance: Tensor, beta: float, eps: float, nu_min: float) -> Tensor:
    """Degrees of freedom after a gradient at this mean distance; all of shape ``[N]``."""
    w = (nu + 1.0) / (nu + mean_distance)
    w_max = (nu + 1.0) / nu
    w_log = w - w.clamp_min(TINY).log()
    w_log_max = (w_max - w_max.log()).clamp_min(-math.log(TINY))
    target = ((nu + 2.0) / (nu + 1.0) + nu) / w_log * (1.0 - nu_min / nu) + (nu_min + eps)
    return torch.lerp(nu, target, (1.0 - beta) * w_log / w_log_max)


def _alike(params: list[Tensor]) -> Iterable[tuple[list[Tensor], list[Tensor]]]:
    """Groups parameters and their gradients by device and dtype."""
    groups: dict[tuple[torch.device, torch.dtype], tuple[list[Tensor], list[Tensor]]] = {}
    for p in params:
        if p.grad is None or not p.numel():
            continue
        if p.grad.is_sparse:
            raise RuntimeError("AdaTerm: sparse gradients are not supported, only dense ones.")
        alike, grads = groups.setdefault((p.device, p.dtype), ([], []))
        alike.append(p)
        grads.append(p.grad)
    return groups.values()


def _check_settings(group: dict[str, Any]) -> None:
    lr = group["lr"]
    if isinstance(lr, Tensor):
        if lr.numel() != 1:
            raise ValueError(f"AdaTerm: lr must be a single number, got shape {tuple(lr.shape)}.")
        lr = lr.item()
    check_real("AdaTerm: lr", lr, at_least=0)
    check_real("AdaTerm: beta", group["beta"], above=0, below=1)
    check_real("AdaTerm: eps", group["eps"], above=TINY**0.5, hint="Its square must not be 0.")
    check_real("AdaTerm: nu_min", group["nu_min"], above=0)
