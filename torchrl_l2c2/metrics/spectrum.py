"""Smoothness of actions, from their spectrum."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from torchrl_l2c2._checks import check_choice, check_real
from torchrl_l2c2.metrics.actions import episodes_of


def amplitude_spectrum(actions: Tensor, sampling_rate: float = 1.0) -> tuple[Tensor, Tensor]:
    r"""Amplitude spectrum of an episode's actions.

    .. math::
        M_i = \frac{c_i}{T} \Big| \sum_t a_t\, e^{-2 \pi \mathrm{i}\, i t / T} \Big|, \qquad
        f_i = \frac{i f_s}{T}, \qquad i = 0, \dots, \lfloor T / 2 \rfloor

    with :math:`c_i = 2`, because a frequency between 0 and :math:`f_s / 2` stands for two of
    opposite sign, and :math:`c_i = 1` at these two ends. A sine of amplitude 1 whose period divides
    the episode has the amplitude 1 at its frequency and 0 elsewhere. The first amplitude is the
    size of the mean. For even :math:`T` the last amplitude, at half the rate, belongs to an action
    that flips from step to step.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least four steps.
        sampling_rate (float): actions per second :math:`f_s`, greater than 0. Default 1.

    Returns:
        tuple: frequencies, shape ``[F]``, in hertz (in cycles per step at the default rate), and
        amplitudes, shape ``[*B, F, A]``, in the action's unit.

    Raises:
        TypeError: the actions are no floating-point tensor, or the rate is no number.
        ValueError: an episode has fewer than four steps, or the rate is not greater than 0.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import amplitude_spectrum
        >>> sine = torch.sin(2 * torch.pi * torch.arange(8.0) / 4).unsqueeze(-1)
        >>> frequencies, amplitudes = amplitude_spectrum(sine, sampling_rate=100.0)
        >>> frequencies.tolist(), amplitudes.squeeze(-1).round(decimals=3).abs().tolist()
        ([0.0, 12.5, 25.0, 37.5, 50.0], [0.0, 0.0, 1.0, 0.0, 0.0])
        >>> flipping = torch.tensor([[1.0], [-1.0], [1.0], [-1.0]])
        >>> amplitude_spectrum(flipping)[1].squeeze(-1).tolist()
        [0.0, 0.0, 1.0]
    """
    actions = episodes_of("amplitude_spectrum", actions, 4)
    check_real("amplitude_spectrum: sampling_rate", sampling_rate, above=0)
    steps = actions.shape[-2]
    # Without the constant part, whose rounding errors would look like motion.
    moved = actions - actions[..., :1, :]
    amplitudes = 2.0 / steps * torch.fft.rfft(moved, dim=-2).abs()
    amplitudes[..., 0, :] = actions.mean(-2).abs()
    if steps % 2 == 0:
        amplitudes[..., -1, :] /= 2.0
    frequencies = torch.fft.rfftfreq(
        steps, 1.0 / sampling_rate, dtype=actions.dtype, device=actions.device
    )
    return frequencies, amplitudes


def spectral_smoothness(actions: Tensor, form: Literal["caps", "asap"] = "caps") -> Tensor:
    r"""The literature's "Sm", in either of its two published forms.

    .. math::
        \mathrm{caps} = \operatorname{mean}_i \Big( M_i \frac{i}{n - 1} \Big), \qquad
        \mathrm{asap} = \sum_i M_i f_i, \qquad n = \lfloor T / 2 \rfloor,

    with :math:`M_i` and :math:`f_i` of :func:`amplitude_spectrum` at a rate of 1. The authors of
    CAPS plot the first form. ASAP, PAVE and CATS print the second form, without normalization of
    the transform: :math:`\frac{2}{T f_s} \sum_i f_i |\mathrm{FFT}_i|`. Both are means over the
    action's dimensions. Smaller is smoother. For even :math:`T` the second form is
    :math:`(T - 2) / 4` times the first. Both depend on the episode's length: of white noise the
    first form falls with its square root, and the second form grows with it. Do not compare
    episodes of different lengths.

    Both leave the highest frequency out, as their authors' code does: sums and means are over
    :math:`i = 0, \dots, n - 1`. For even :math:`T` this frequency is half the rate, and an action
    that flips from step to step counts as perfectly smooth. :func:`roughness` includes it and
    hardly depends on the length.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least four steps.
        form (str): ``"caps"`` or ``"asap"``. Default ``"caps"``.

    Returns:
        Tensor: the measure of each episode, shape ``[*B]``, in the action's unit.

    Raises:
        TypeError: the actions are no floating-point tensor, or the form is no string.
        ValueError: an episode has fewer than four steps, or another form.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import spectral_smoothness
        >>> sine = torch.sin(2 * torch.pi * torch.arange(8.0) / 4).unsqueeze(-1)
        >>> spectral_smoothness(sine), spectral_smoothness(sine, "asap")
        (tensor(0.1667), tensor(0.2500))
        >>> flipping = torch.tensor([[1.0], [-1.0], [1.0], [-1.0]])
        >>> spectral_smoothness(flipping)
        tensor(0.)
    """
    check_choice("spectral_smoothness: form", form, ("caps", "asap"))
    actions = episodes_of("spectral_smoothness", actions, 4)
    bins = actions.shape[-2] // 2
    frequencies, amplitudes = amplitude_spectrum(actions)
    frequencies, amplitudes = frequencies[:bins], amplitudes[..., :bins, :]
    if form == "asap":
        return (amplitudes * frequencies.unsqueeze(-1)).sum(-2).mean(-1)
    weights = torch.linspace(0, 1, bins, dtype=amplitudes.dtype, device=actions.device)
    return (amplitudes * weights.unsqueeze(-1)).mean((-2, -1))


def roughness(actions: Tensor) -> Tensor:
    r"""The mean frequency of an episode's actions, weighted by amplitude, as a share of the rate.

    .. math::
        \frac{\sum_{i \ge 1} M_i f_i}{\sum_{i \ge 1} M_i}

    with :math:`M_i` and :math:`f_i` of :func:`amplitude_spectrum` at a rate of 1: the spectral
    centroid, a mean over the action's dimensions. Between 0 and 0.5: white noise has 0.25 and an
    action that flips from step to step has 0.5, for any amplitude and nearly any length. It
    measures how fast an action moves, not how much. The constant part is left out.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least four steps.

    Returns:
        Tensor: the measure of each episode, shape ``[*B]``; NaN where a dimension never changes.

    Raises:
        TypeError: the actions are no floating-point tensor.
        ValueError: an episode has fewer than four steps.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import roughness
        >>> sine = torch.sin(2 * torch.pi * torch.arange(8.0) / 4).unsqueeze(-1)
        >>> roughness(3 + 2 * sine)
        tensor(0.2500)
        >>> roughness(torch.tensor([[1.0], [-1.0], [1.0], [-1.0]]))
        tensor(0.5000)
    """
    actions = episodes_of("roughness", actions, 4)
    frequencies, amplitudes = amplitude_spectrum(actions)
    moving, weights = amplitudes[..., 1:, :], frequencies[1:].unsqueeze(-1)
    return ((moving * weights).sum(-2) / moving.sum(-2)).mean(-1)
