"""Parts of the pictures of the docs: panoramas as grey levels, plots, labels, and pictures beside each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from photonpano.photometry import tone_mapped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Picture = NDArray[np.uint8]

GAP, LABEL = 8, 26
"""Pixels between pictures, and above a picture for its label."""


def picture(flux: NDArray[np.float32], white: float) -> Picture:
    """Return flux as 8-bit sRGB; unknown pixels are white, as is the page."""
    return np.where(np.isfinite(flux), tone_mapped(flux, white), np.uint8(255))


def drawn(figure: Figure) -> Picture:
    """Draw a figure: (H, W, 4)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def labelled(image: Picture, label: str) -> Picture:
    """Write a line above a picture, smaller where it would be longer than the picture is wide."""
    strip = Figure(figsize=(image.shape[1] / 100, LABEL / 100), dpi=100)
    text = strip.text(2 / image.shape[1], 0.35, label, fontsize=10, color="0.25")
    text.set_fontsize(10 * min(1, (image.shape[1] - 4) / text.get_window_extent().width))
    grey = drawn(strip)[..., 0]
    return np.vstack([grey[:LABEL, : image.shape[1]], image])


def beside(pictures: Sequence[Picture]) -> Picture:
    """Put pictures of one height side by side."""
    gap = np.full((pictures[0].shape[0], GAP), 255, np.uint8)
    return np.hstack([part for each in pictures for part in (each, gap)][:-1])


def stacked(pictures: Sequence[Picture]) -> Picture:
    """Put pictures of one width below each other."""
    return np.vstack(pictures)
