"""Parts of the pictures of the docs: panoramas as grey levels, plots, labels, and pictures beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from photonpano import Panorama
from photonpano.geometry import transform_points
from photonpano.photometry import tone_mapped

Picture: TypeAlias = NDArray[np.uint8]
GAP, LABEL = 8, 26  # px between pictures, and above a picture for its label
WHITE_SHARE = 0.995  # quantile of the flux that is white


def white_of(flux: NDArray[np.float32]) -> float:
    """Return the flux that is shown as white."""
    return float(np.nanquantile(flux, WHITE_SHARE))


def picture(flux: NDArray[np.float32], white: float | None = None) -> Picture:
    """Return flux as 8-bit sRGB, up to its own white by default; unknown pixels are white, as is the page."""
    return np.where(np.isfinite(flux), tone_mapped(flux, white_of(flux) if white is None else white), np.uint8(255))


def panels(width: float, height: float, rows: int = 1, columns: int = 1, **axes: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure, whose size is in hundreds of px, and its axes row by row."""
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **axes).ravel())


def name_axes(panel: Axes, x: str, y: str = "", fontsize: float | None = 9) -> None:
    """Name the axes of a plot."""
    panel.set_xlabel(x, fontsize=fontsize)
    if y:
        panel.set_ylabel(y, fontsize=fontsize)


def ticks(panel: Axes, at: Mapping[float, str]) -> None:
    """Mark some places of the x axis, and no others."""
    panel.set_xticks(list(at), list(at.values()))
    panel.set_xticks([], minor=True)


def drawn(figure: Figure) -> Picture:
    """Draw a figure: (H, W, 4)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def in_bgr(figure: Figure) -> Picture:
    """Draw a figure in colours: (H, W, 3), blue first."""
    return drawn(figure)[..., 2::-1]


def labelled(image: Picture, label: str) -> Picture:
    """Write a line above a picture, smaller where it would be longer than the picture is wide."""
    strip = Figure(figsize=(image.shape[1] / 100, LABEL / 100), dpi=100)
    text = strip.text(2 / image.shape[1], 0.35, label, fontsize=10, color="0.25")
    text.set_fontsize(10 * min(1, (image.shape[1] - 4) / text.get_window_extent().width))
    line = drawn(strip)[:LABEL, : image.shape[1], 0]
    return np.vstack([line if image.ndim == 2 else in_colour(line), image])


def all_labelled(images: Mapping[str, Picture]) -> list[Picture]:
    """Write the name of each picture above it."""
    return [labelled(image, name) for name, image in images.items()]


def beside(pictures: Sequence[Picture]) -> Picture:
    """Put pictures side by side, as high as the lowest."""
    height = min(len(each) for each in pictures)
    gap = np.full((height, GAP, *pictures[0].shape[2:]), 255, np.uint8)
    return np.hstack([part for each in pictures for part in (each[:height], gap)][:-1])


def widened(image: Picture, width: int) -> Picture:
    """Fill up with white, on the right."""
    missing = [(0, 0), (0, width - image.shape[1]), *[(0, 0)] * (image.ndim - 2)]
    return np.pad(image, missing, constant_values=255)


def in_rows(rows: Sequence[Picture], gap: int = GAP) -> Picture:
    """Put pictures below each other, with gaps."""
    width = max(row.shape[1] for row in rows)
    between = np.full((gap, width, *rows[0].shape[2:]), 255, np.uint8)
    return np.vstack([part for row in rows for part in (widened(row, width), between)][:-1])


def in_colour(image: Picture) -> Picture:
    """Return a grey picture with three equal channels."""
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def magnified(image: Picture, times: int) -> Picture:
    """Repeat each pixel."""
    return np.repeat(np.repeat(image, times, 0), times, 1)


def fitted(image: Picture, width: int) -> Picture:
    """Scale a picture to a width."""
    size = width, round(image.shape[0] * width / image.shape[1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def around(image: NDArray[Any], point: tuple[int, int], radius: tuple[int, int]) -> NDArray[Any]:
    """Return the surroundings of a pixel (x, y), of twice the radius."""
    (x, y), (width, height) = point, radius
    return image[y - height : y + height, x - width : x + width]


def place(panorama: Panorama, point: Sequence[float], radius: tuple[int, int], white: float) -> Picture:
    """Return the surroundings of a point of the reference plane, magnified twice."""
    height, width = panorama.flux.shape[:2]
    radius = min(radius[0], width // 2), min(radius[1], height // 2)
    x, y = transform_points(panorama.canvas, np.array([point]))[0].round().astype(int)
    x, y = int(np.clip(x, radius[0], width - radius[0])), int(np.clip(y, radius[1], height - radius[1]))
    return magnified(picture(around(panorama.flux, (x, y), radius), white), 2)


def encoded(image: Picture, levels: int, white: int = 254) -> bytes:
    """Return a PNG, grey or BGR, of so many levels, which is smaller; levels above white are white, as is the page."""
    coarse = np.where(image > white, 255, image & (256 - 256 // levels)).astype(np.uint8)
    return cv2.imencode(".png", coarse, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def save(image: Picture, path: Path, most_bytes: int) -> None:
    """Write a PNG of 32 levels, scaled down until it is small enough."""
    while len(content := encoded(image, 32, 250)) >= most_bytes:
        image = cv2.resize(image, None, fx=0.9, fy=0.9, interpolation=cv2.INTER_AREA).astype(np.uint8)
    path.write_bytes(content)
