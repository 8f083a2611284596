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
from photonpano.values import FloatArray

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_JPEG_QUALITY = 90
WIDTH_IN = 10.0
_X_LABEL_IN, _Y_LABEL_IN = 0.25, 0.55  # distance of the labels of axes from these
_MAP_PIXELS = 500  # longer side of a map
_ROW_SIZE = 990, 480  # maximum width and height of a row of maps, in pixels of the page
_GAP = 40  # between the columns of the page
# Evenly spaced colours of maps: between them values are interpolated, and a browser blends them in legends.
_COLOURS = {
    "inferno": "000004 210c4a 57106e 8a226a bc3754 e45a31 f98e09 f9cb35 fcffa4",
    "magma": "000004 1d1147 51127c 832681 b73779 e75263 fc8961 fec488 fcfdbf",
    "red-blue": "053061 2a71b2 6bacd1 c2ddec f7f6f6 fbccb4 e48066 ba2832 67001f",
    "twilight": "e2d9e2 95b5c7 6276ba 592a8f 2f1436 741e4f b25652 cca389 e2d9e2",
    "viridis": "440154 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725",
}

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
    gap_in: float = 0.25,
    share_x: bool = False,
) -> list[Axes]:
    """Add axes in a column, in rows of these relative heights, with their labels at fixed distances."""
    from matplotlib.transforms import ScaledTranslation

    width, height = figure.get_size_inches()
    inner = height - margins.top - margins.bottom
    n_rows = len(rows)
    grid = figure.add_gridspec(
        n_rows,
        left=margins.left / width,
        right=1 - margins.right / width,
        bottom=margins.bottom / height,
        top=1 - margins.top / height,
        hspace=gap_in * n_rows / (inner - (n_rows - 1) * gap_in),
        height_ratios=rows,
    )
    axes = list(grid.subplots(squeeze=False, sharex=share_x).ravel())
    for each in axes:
        inches = figure.dpi_scale_trans
        each.yaxis.set_label_coords(0, 0.5, each.transAxes + ScaledTranslation(-_Y_LABEL_IN, 0, inches))
        each.xaxis.set_label_coords(0.5, 0, each.transAxes + ScaledTranslation(0, -_X_LABEL_IN, inches))
    return axes


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


def map_of(values: NDArray[Any], colours: str, low: float, high: float) -> dict[str, Any]:
    """Return a map as a picture in colours, transparent where it is NaN, with the range and the colours of its legend."""
    share = shrunk(np.isfinite(values).astype(np.float32), _MAP_PIXELS)
    small = shrunk(np.nan_to_num(values).astype(np.float32), _MAP_PIXELS) / np.maximum(share, np.float32(1e-6))
    legend = _COLOURS[colours].split()
    between = np.linspace(0, len(legend) - 1, 256)
    channels = zip(*map(bytes.fromhex, legend), strict=True)
    table = np.rint([np.interp(between, range(len(legend)), channel) for channel in channels]).astype(np.uint8).T
    shades = table[np.rint(255 * np.clip((small - low) / max(high - low, 1e-12), 0, 1)).astype(np.uint8)]
    picture = np.dstack([shades, np.where(share > 0, 255, 0).astype(np.uint8)])
    return {"uri": png_uri(picture), "low": low, "high": high, "colours": [f"#{colour}" for colour in legend]}


def page_scale(shape: tuple[int, int], columns: int = 1) -> float:
    """Return how many pixels of the page a pixel of images with this shape takes, in columns of the page."""
    height, width = shape
    return min(((_ROW_SIZE[0] + _GAP) / columns - _GAP) / width, _ROW_SIZE[1] / height)


def svg_path(points: FloatArray) -> str:
    """Return the data of an SVG path through points, (N, 2)."""
    return "M" + " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


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
