"""A video of policies side by side, with their actions below."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l2c2.experiment.analysis.diagnosis.measured import Diagnosis
from torchrl_l2c2.experiment.analysis.diagnosis.pictures import COLORS, busiest
from torchrl_l2c2.experiment.analysis.reports.figures import drawn, subplots
from torchrl_l2c2.experiment.analysis.video import Picture, write_video
from torchrl_l2c2.experiment.envs.pictures import USUAL_RATE

WIDTH = 320  # of a policy's column, in pixels
STRIP = 100  # height of its strip
FASTEST = 30.0  # pictures a second; faster simulators lose some
CURSOR = (194, 24, 43)


def film(diagnoses: Sequence[Diagnosis]) -> bytes:
    """An MP4 file of the pictures of the policies' first episodes, at the speed of simulated time.

    An episode that ends earlier than others stays at its last picture.

    Args:
        diagnoses (sequence of Diagnosis): Diagnoses with pictures and the same control rate.

    Raises:
        ImportError: the ``video`` extra is missing.
        OSError: the film cannot be written.
    """
    rate = (diagnoses[0].rate or USUAL_RATE) / diagnoses[0].picture_every
    apart = max(1, round(rate / FASTEST))
    strips = [_strip(one) for one in diagnoses]
    length = max(len(one.pictures) for one in diagnoses)
    heights = [_shrunk(one.pictures[0]).shape[0] for one in diagnoses]
    seen = []
    for number in [*range(0, length - 1, apart), length - 1]:
        columns = [
            _column(one, strip, number, max(heights))
            for one, strip in zip(diagnoses, strips, strict=True)
        ]
        seen.append(np.concatenate(columns, 1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        write_video(path, seen, rate / apart)
        return path.read_bytes()


def _column(one: Diagnosis, strip: tuple[Picture, Any], number: int, height: int) -> Picture:
    number = min(number, len(one.pictures) - 1)
    drawn_strip, places = strip
    below = drawn_strip.copy()
    below[:, places[min(number * one.picture_every, len(places) - 1)]] = CURSOR
    above = _shrunk(one.pictures[number])
    rest = np.full((height - len(above), WIDTH, 3), 255, np.uint8)
    column: Picture = np.concatenate([above, rest, below])
    return column


def _shrunk(picture: Picture) -> Picture:
    """As wide as a column."""
    from PIL import Image

    height, width, _ = picture.shape
    size = (WIDTH, 2 * round(height * WIDTH / width / 2))  # even, for the encoder
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


def _strip(one: Diagnosis) -> tuple[Picture, Any]:
    """The actions over time, and the column of pixels of every step."""
    from matplotlib.image import imread

    dots = 110  # an inch, as figures are drawn
    figure, (axis,) = subplots(1, 1, (WIDTH / dots, STRIP / dots))
    figure.set_layout_engine("none")
    axis.set_position((0.0, 0.0, 1.0, 0.8))
    for place, number in enumerate(busiest(one)):
        axis.plot(one.relative[:, number].numpy(), color=COLORS[place], linewidth=0.7)
    axis.set_ylim(-0.08, 1.08)
    axis.set_axis_off()
    figure.suptitle(one.name, fontsize=7, y=0.99, parse_math=False)
    pixels = np.asarray(imread(io.BytesIO(drawn(figure, "png"))))[..., :3]
    steps = np.stack([np.arange(len(one.actions)), np.zeros(len(one.actions))], 1)
    places = axis.transData.transform(steps)[:, 0] * pixels.shape[1] / figure.bbox.width
    return (255 * pixels).astype(np.uint8), places.round().astype(int).clip(0, pixels.shape[1] - 1)
