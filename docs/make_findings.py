"""Draws ``docs/findings.svg``: ``python docs/make_findings.py``.

It shows actions of a second at 50 Hz, with what ``diagnose`` says of each.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchrl_l2c2.experiment.analysis.diagnosis import diagnose_actions, findings
from torchrl_l2c2.experiment.analysis.reports.figures import save, subplots

PICTURE = Path(__file__).parent / "findings.svg"
RATE = 50.0


def signals() -> dict[str, tuple[str, Tensor]]:
    """Titles and actions ``[T, 1]`` in [-1, 1], by the kind of their first finding."""
    step = torch.arange(51.0).unsqueeze(1)
    slow, flip = torch.sin(2 * torch.pi * step / 50), (-1.0) ** step
    noise = torch.randn(51, 1, generator=torch.Generator().manual_seed(0))
    square = torch.where(torch.sin(2 * torch.pi * (step + 1) / 14) > 0, 1.0, -1.0)
    return {
        "flips": ("flips from step to step", 0.5 * flip),
        "chatters": ("chatters around a slower movement", 0.7 * slow + 0.15 * flip),
        "rough": ("moves like noise", 0.3 * noise),
        "bang-bang": ("bang-bang: jumps between its bounds", square),
        "pinned": ("pinned at a bound", (1.6 * slow + 1.0).clamp(-1, 1)),
        "smooth": ("smooth", 0.25 * slow),
    }


def main() -> None:
    """Draws the picture: faults red, a smooth action green."""
    figure, axes = subplots(3, 2, (9.5, 4.4))
    figure.set_facecolor("white")
    for axis, (title, action) in zip(axes, signals().values(), strict=True):
        found = findings(diagnose_actions(action, bounds=(-1.0, 1.0)))[0]
        color = "#c2182b" if found.fault else "#2a7f62"
        axis.plot(torch.arange(51) / RATE, action, color=color, lw=1.2, marker=".", markersize=3)
        axis.set(title=title, xlabel="seconds", ylabel="action", ylim=(-1.15, 1.15))
        axis.title.set_fontsize(10)
        axis.set_yticks([-1, 0, 1])
        axis.grid(alpha=0.25)
        axis.label_outer()
    save(figure, PICTURE)


if __name__ == "__main__":
    main()
