"""The figures of the report: inline SVG whose colours the page's style sheet decides, for light, dark and print."""

from __future__ import annotations

import base64
import importlib
import io
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import apply, corners
from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.record.schema import LevelRecord, PanoramaRecord
from photonpano.text import duration
from photonpano.values import FloatArray, FluxImage, true_spans

if TYPE_CHECKING:  # importing matplotlib takes a second
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

JPEG_QUALITY = 90
MAX_INSTANTS = 1500
"""Number of instants at which a long trajectory is drawn, evenly spaced."""

WIDTH_IN = 10.0
MAX_MAP_HEIGHT_IN = 5.0
MIN_MAP_IN = 0.8
MAP_PIXELS = 1000

# matplotlib knows no CSS variables: each of these stand-ins is replaced by one in the finished SVG.
INK, MUTED, LINE, PAPER = "#010101", "#010102", "#010103", "#010104"
SERIES = ("#010201", "#010202", "#010203", "#010204", "#010205")
_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    LINE: "var(--line)",
    PAPER: "var(--paper)",
    **{colour: f"var(--series-{number})" for number, colour in enumerate(SERIES, start=1)},
}

_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "photonpano",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "figure.facecolor": "none",
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
}

STAGE_NAMES = {"resample": "re-sample", "merge": "merge", "locate": "locate", "interpolate": "interpolate"}


@contextmanager
def loading_figures() -> Iterator[None]:
    """Import matplotlib in another thread while the block runs: it takes a second that nothing waits for."""
    with ThreadPoolExecutor(1) as aside:
        aside.submit(lambda: [importlib.import_module(f"matplotlib.{name}") for name in ("figure", "backends.backend_svg")])
        yield


def path_over_time(motion: FrameMotion, frame_rate_hz: float | None) -> str:
    """Draw the position and the speed of the frame centre, and the expected corner error, over time."""
    from matplotlib.ticker import LogLocator

    instants = _instants(len(motion.homographies))
    centre = _centre(motion.frame_shape)
    path = apply(motion.homographies[instants], centre)[:, 0] - centre[0]
    with _figure(WIDTH_IN, 6.0) as figure:
        position, speed, error = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
        for values, name, colour in zip(path.T, ("x", "y"), SERIES, strict=False):
            position.plot(instants, values, color=colour)
            end = instants[-1], values[-1]
            position.annotate(
                name, end, xytext=(6, 0), textcoords="offset points", va="center", color=colour, fontweight="bold"
            )
        position.set_ylabel("frame centre (px)")
        if len(instants) > 1:
            steps = np.linalg.norm(np.diff(path, axis=0), axis=1) / np.diff(instants)
            speed.plot((instants[:-1] + instants[1:]) / 2, steps, color=SERIES[2])
        speed.set_ylim(bottom=0)
        speed.set_ylabel("speed (px/frame)")
        known = np.where(np.isfinite(motion.std_px), motion.std_px, np.nan)
        error.plot(instants, known[instants], color=INK)
        error.set_yscale("log")
        error.yaxis.set_major_formatter("{x:g}")
        error.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        error.yaxis.set_minor_formatter("{x:g}")
        error.set_ylabel("expected error (px)")
        error.set_xlabel("frame")
        error.set_xlim(-0.5, len(motion.homographies) - 0.5)
        error.xaxis.set_major_formatter("{x:,.0f}")
        for axes in (position, speed, error):
            _shade_not_located(axes, motion)
        if frame_rate_hz is not None and len(instants) > 1:
            _add_time_axis(position, len(motion.homographies), frame_rate_hz)
        figure.align_ylabels()
        return _svg(figure, "path-over-time")


def path_on_panorama(motion: FrameMotion, panorama: RenderedPanorama) -> str:
    """Draw the path of the frame centre over the panorama, with the outlines of the first, the reference and the last frame."""
    instants = _instants(len(motion.homographies))
    to_canvas = panorama.thumbnail.canvas @ motion.homographies
    path = apply(to_canvas[instants], _centre(motion.frame_shape))[:, 0]
    height, width = panorama.picture.shape
    with _map_figure(height, width) as (figure, axes):
        picture = shrunk(panorama.picture, MAP_PIXELS)
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, extent=_extent(height, width), alpha=0.55)
        for index, style in ((motion.reference, "-"), (0, ":"), (-1, ":")):
            outline = apply(to_canvas[index], corners(motion.frame_shape))
            axes.plot(*np.vstack([outline, outline[:1]]).T, color=INK, linewidth=0.9, linestyle=style)
        axes.plot(*path.T, color=PAPER, linewidth=3.5)
        axes.plot(*path.T, color=SERIES[1], linewidth=1.6)
        for point, name in ((path[0], "first"), (path[-1], "last")):
            axes.plot(*point, "o", color=SERIES[1], markeredgecolor=PAPER, markersize=7)
            axes.annotate(name, point, xytext=(0, 9), textcoords="offset points", ha="center", fontweight="bold")
        return _svg(figure, "path-on-panorama")


def coverage_map(coverage: FluxImage) -> str:
    """Draw the number of frames that saw each pixel of the panorama; unseen pixels are grey."""
    height, width = coverage.shape
    with _map_figure(height, width, side_in=0.9) as (figure, axes):
        axes.set_facecolor(LINE)
        small = shrunk(np.nan_to_num(coverage), MAP_PIXELS)
        image = axes.imshow(np.ma.masked_less_equal(small, 0), cmap="viridis", vmin=0, extent=_extent(height, width))
        bar = figure.colorbar(image, ax=axes, fraction=0.15, pad=0.02, shrink=0.9, aspect=14, format="{x:,.0f}")
        bar.outline.set_visible(False)
        bar.set_label("frames")
        return _svg(figure, "coverage")


def stage_times(levels: Sequence[LevelRecord], panorama: PanoramaRecord | None) -> str:
    """Draw the seconds of each stage of each level, and of the panorama."""
    names = [f"level {level['level']}" for level in levels] + (["panorama"] if panorama else [])
    with _figure(WIDTH_IN, 0.9 + 0.36 * len(names)) as figure:
        axes = figure.subplots()
        ends = np.zeros(len(levels))
        for (stage, name), colour in zip(STAGE_NAMES.items(), SERIES, strict=False):
            seconds = np.array([level["seconds"].get(stage, 0.0) for level in levels])
            axes.barh(names[: len(levels)], seconds, left=ends, height=0.62, color=colour, label=name)
            ends = ends + seconds
        totals = ends.tolist()
        if panorama:
            axes.barh(["panorama"], panorama["seconds"], height=0.62, color=SERIES[4], label="render")
            totals.append(panorama["seconds"])
        for name, total in zip(names, totals, strict=True):
            axes.annotate(duration(total), (total, name), xytext=(5, 0), textcoords="offset points", va="center", color=MUTED)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", colors=INK)
        axes.set_xlabel("seconds")
        figure.legend(loc="outside upper left", ncols=5, handlelength=1, handleheight=1, columnspacing=1.4)
        return _svg(figure, "stage-times")


def shrunk(image: NDArray[Any], max_pixels: int) -> NDArray[Any]:
    """Reduce an image by averaging until its longer side has at most `max_pixels`; smaller images are not changed."""
    import cv2

    height, width = image.shape[:2]
    scale = max_pixels / max(height, width)
    if scale >= 1:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def jpeg_uri(image: NDArray[np.uint8]) -> str:
    """Return an (H, W) grey or (H, W, 3) red-green-blue image as a data URI."""
    import cv2

    in_opencv_order = image if image.ndim == 2 else image[..., ::-1]
    _, encoded = cv2.imencode(".jpg", in_opencv_order, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def _instants(n_frames: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, n_frames - 1, min(n_frames, MAX_INSTANTS)).round().astype(np.int64))


def _centre(frame_shape: tuple[int, int]) -> FloatArray:
    return np.asarray(corners(frame_shape).mean(axis=0, keepdims=True))


def _extent(height: int, width: int) -> tuple[float, float, float, float]:
    """Return the edges of an image in its own pixels, whose centres are integers."""
    return -0.5, width - 0.5, height - 0.5, -0.5


def _shade_not_located(axes: Axes, motion: FrameMotion) -> None:
    for span in true_spans(~motion.located):
        axes.axvspan(span.start - 0.5, span.stop - 0.5, color=MUTED, alpha=0.18, linewidth=0)


def _add_time_axis(axes: Axes, n_frames: int, frame_rate_hz: float) -> None:
    """Add the time along the top, in seconds or milliseconds."""
    factor, unit = (1.0, "s") if n_frames / frame_rate_hz >= 1 else (1e3, "ms")
    scale = factor / frame_rate_hz

    def to_time(frame: Any) -> Any:
        return frame * scale

    def to_frame(time: Any) -> Any:
        return time / scale

    time = axes.secondary_xaxis("top", functions=(to_time, to_frame))
    time.set_xlabel(f"time ({unit})")
    time.spines["top"].set_visible(False)


@contextmanager
def _figure(width_in: float, height_in: float) -> Iterator[Figure]:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


@contextmanager
def _map_figure(height: int, width: int, side_in: float = 0) -> Iterator[tuple[Figure, Axes]]:
    """Open a figure with the proportions of a panorama, with `side_in` inches beside it for a colour bar."""
    margin_in = 0.9 + side_in
    map_width = min(WIDTH_IN - margin_in, MAX_MAP_HEIGHT_IN * width / height)
    size_in = max(map_width, MIN_MAP_IN), max(map_width * height / width, MIN_MAP_IN)
    with _figure(size_in[0] + margin_in, size_in[1] + 0.55) as figure:
        axes = figure.subplots()
        axes.grid(visible=False)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.locator_params(axis="x", nbins=max(2, min(9, int(map_width))))
        axes.locator_params(axis="y", nbins=5)
        for ticks in (axes.xaxis, axes.yaxis):
            ticks.set_major_formatter("{x:,.0f}")
        yield figure, axes


def _svg(figure: Figure, name: str) -> str:
    """Return the SVG element, with unique identifiers and the colour variables of the page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    # Inside HTML the namespaces are known, and several drawings share one space of identifiers.
    svg = re.sub(r'\sxmlns(:xlink)?="[^"]*"', "", svg).replace("xlink:href=", "href=")
    svg = re.sub(r'\b(id="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    for stand_in, variable in _VARIABLES.items():
        svg = svg.replace(stand_in, variable)
    return svg.strip()
