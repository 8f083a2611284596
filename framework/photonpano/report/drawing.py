"""What pages and figures of the report share: templates that are filled, and inline SVG.

The page's style sheet decides the colours of a figure, for light, dark and print.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from photonpano import text
from photonpano.record.batch_row import written

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure

_JPEG_QUALITY = 90
WIDTH_IN = 10.0
_MAX_MAP_HEIGHT_IN = 5.0
_MIN_MAP_IN = 0.8
BAR_IN = 1.0  # room for a colour bar to the right of a map, with its numbers and its label
MAP_PIXELS = 1000
_X_LABEL_IN, _Y_LABEL_IN, _BAR_LABEL_IN = 0.25, 0.55, 0.45  # distance of the labels of axes, and of colour bars, from these

# matplotlib knows no CSS variables: each of these stand-ins is replaced by one in the finished SVG.
INK, MUTED, LINE, PAPER, BAD = "#010101", "#010102", "#010103", "#010104", "#010105"
SERIES = ("#010201", "#010202", "#010203", "#010204", "#010205")
_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    LINE: "var(--line)",
    PAPER: "var(--paper)",
    BAD: "var(--bad)",
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


@contextmanager
def plain_figure(width_in: float, height_in: float) -> Iterator[Figure]:
    """Open a figure in the style of the report."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        yield Figure(figsize=(width_in, height_in))


@dataclass(frozen=True, slots=True)
class Margins:
    """Room around axes, in inches. It is fixed, as measuring all texts to find it takes longer than drawing them."""

    left: float = 0.8
    right: float = 0.1
    top: float = 0.1
    bottom: float = 0.5


def add_axes(
    figure: Figure,
    margins: Margins,
    rows: Sequence[float] = (1,),
    *,
    columns: int = 1,
    gap_in: float = 0.25,
    share_x: bool = False,
) -> list[Axes]:
    """Add axes in a column or in a row, with their labels at fixed distances.

    The rows have these relative heights, and the columns are equal.
    """
    from matplotlib.transforms import ScaledTranslation

    width, height = figure.get_size_inches()
    inner = width - margins.left - margins.right, height - margins.top - margins.bottom
    n_rows = len(rows)
    grid = figure.add_gridspec(
        n_rows,
        columns,
        left=margins.left / width,
        right=1 - margins.right / width,
        bottom=margins.bottom / height,
        top=1 - margins.top / height,
        hspace=gap_in * n_rows / (inner[1] - (n_rows - 1) * gap_in),
        wspace=gap_in * columns / (inner[0] - (columns - 1) * gap_in),
        height_ratios=rows,
    )
    axes = list(grid.subplots(squeeze=False, sharex=share_x).ravel())
    for each in axes:
        inches = figure.dpi_scale_trans
        each.yaxis.set_label_coords(0, 0.5, each.transAxes + ScaledTranslation(-_Y_LABEL_IN, 0, inches))
        each.xaxis.set_label_coords(0.5, 0, each.transAxes + ScaledTranslation(0, -_X_LABEL_IN, inches))
    return axes


@contextmanager
def map_figure(height: int, width: int, side_in: float = 0) -> Iterator[tuple[Figure, Axes]]:
    """Open a figure with the proportions of a panorama, with `side_in` inches beside it for a colour bar."""
    margins = Margins(left=0.6, right=0.3 + side_in, top=0.15, bottom=0.35)
    margin_in = margins.left + margins.right
    map_width = min(WIDTH_IN - margin_in, _MAX_MAP_HEIGHT_IN * width / height)
    size_in = max(map_width, _MIN_MAP_IN), max(map_width * height / width, _MIN_MAP_IN)
    with plain_figure(size_in[0] + margin_in, size_in[1] + margins.top + margins.bottom) as figure:
        [axes] = add_axes(figure, margins)
        _show_pixels(axes, height, width)
        axes.locator_params(axis="x", nbins=max(2, min(9, int(map_width))))
        axes.locator_params(axis="y", nbins=5)
        yield figure, axes


@contextmanager
def maps_figure(height: int, width: int, n_maps: int) -> Iterator[tuple[Figure, list[Axes]]]:
    """Open a figure of 2 or 3 maps in a row, each with room for a colour bar, but the third."""
    margins = Margins(left=0.6, right=BAR_IN if n_maps == 2 else 0.1, top=0.35, bottom=0.3)
    gap_in = BAR_IN + 0.35
    map_width = (WIDTH_IN - margins.left - margins.right - (n_maps - 1) * gap_in) / n_maps
    map_height = float(np.clip(map_width * height / width, _MIN_MAP_IN, 4.0))
    with plain_figure(WIDTH_IN, map_height + margins.top + margins.bottom) as figure:
        maps = add_axes(figure, margins, columns=n_maps, gap_in=gap_in)
        for axes in maps:
            _show_pixels(axes, height, width)
            axes.set_facecolor(LINE)
            axes.locator_params(nbins=4)
        yield figure, maps


def _show_pixels(axes: Axes, height: int, width: int) -> None:
    """Give axes the coordinates of the pixels of an image."""
    axes.grid(visible=False)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    for ticks in (axes.xaxis, axes.yaxis):
        ticks.set_major_formatter("{x:,.0f}")


def add_colour_bar(axes: Axes, image: Any, label: str, numbers: str) -> Colorbar:
    """Add the colours of an image to the right of its axes, which have `BAR_IN` inches of room there."""
    from matplotlib.transforms import ScaledTranslation, blended_transform_factory

    figure: Any = axes.get_figure(root=True)
    right_edge: Any = axes.transAxes
    inches = figure.dpi_scale_trans
    beside = blended_transform_factory(inches + ScaledTranslation(1, 0, right_edge), axes.transAxes)
    place = axes.inset_axes((0.1, 0.05, 0.16, 0.9), transform=beside)
    bar: Colorbar = figure.colorbar(image, cax=place, format=numbers)
    bar.outline.set_visible(False)
    bar.set_label(label)
    bar.ax.yaxis.set_label_coords(1, 0.5, bar.ax.transAxes + ScaledTranslation(_BAR_LABEL_IN, 0, inches))
    return bar


def svg_of(figure: Figure, name: str) -> str:
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


def mark_frames(axes: Axes, start: int, stop: int) -> None:
    """Let the x axis count the frames of a span."""
    axes.set_xlabel("frame")
    axes.set_xlim(start - 0.5, stop - 0.5)
    axes.xaxis.set_major_formatter("{x:,.0f}")


def mark_logarithmic(axes: Axes) -> None:
    """Make the y axis logarithmic, with numbers at 1, 2 and 5."""
    from matplotlib.ticker import LogLocator

    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axes.yaxis.set_minor_formatter("{x:g}")


def add_time_axis(axes: Axes, n_frames: int, frame_rate_hz: float) -> None:
    """Add the time along the top, in seconds or milliseconds."""
    from matplotlib.transforms import ScaledTranslation

    factor, unit = (1.0, "s") if n_frames / frame_rate_hz >= 1 else (1e3, "ms")
    scale = factor / frame_rate_hz

    def to_time(frame: Any) -> Any:
        return frame * scale

    def to_frame(time: Any) -> Any:
        return time / scale

    time = axes.secondary_xaxis("top", functions=(to_time, to_frame))
    time.set_xlabel(f"time ({unit})")
    figure: Any = axes.get_figure(root=True)
    inches = figure.dpi_scale_trans
    time.xaxis.set_label_coords(0.5, 1, axes.transAxes + ScaledTranslation(0, _X_LABEL_IN, inches))
    time.spines["top"].set_visible(False)


def extent_of(height: int, width: int) -> tuple[float, float, float, float]:
    """Return the edges of an image in its own pixels, whose centres are integers."""
    return -0.5, width - 0.5, height - 0.5, -0.5


def shrunk(image: NDArray[Any], max_pixels: int) -> NDArray[Any]:
    """Reduce an image by averaging until its longer side has at most `max_pixels`; smaller images are not changed."""
    import cv2

    height, width = image.shape[:2]
    scale = max_pixels / max(height, width)
    if scale >= 1:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def png_uri(image: NDArray[np.uint8]) -> str:
    """Return an (H, W, 4) image of red, green, blue and opacity as a data URI."""
    import cv2

    _, encoded = cv2.imencode(".png", image[..., [2, 1, 0, 3]])
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()


def jpeg_uri(image: NDArray[np.uint8], quality: int = _JPEG_QUALITY) -> str:
    """Return an (H, W) grey or (H, W, 3) red-green-blue image as a data URI."""
    import cv2

    in_opencv_order = image if image.ndim == 2 else image[..., ::-1]
    _, encoded = cv2.imencode(".jpg", in_opencv_order, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def filled(template: str, package: str = "photonpano.report", /, **values: Any) -> str:
    """Return the page that a template of a package makes of its values; it may extend those of this one."""
    page: str = _environment(package).get_template(template).render(**values)
    return page


@cache
def _environment(package: str) -> Environment:
    """Return the environment of the templates of a package, with filters that write numbers."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(each) for each in (package, "photonpano.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("byte_size", "count", "counted", "duration", "pixels", "rate", "share", "span"):
        environment.filters[name] = getattr(text, name)
    environment.filters["setting"] = written
    return environment


def yaml_of(document: Mapping[str, Any]) -> str:
    """Write a spec as YAML."""
    from ruamel.yaml import YAML

    yaml = YAML()
    yaml.width = 100
    buffer = io.StringIO()
    yaml.dump(document, buffer)
    return buffer.getvalue()
