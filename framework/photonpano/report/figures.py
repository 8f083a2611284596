"""The figures of the report: of the motion, the coverage, and of the residuals.

Residuals are shown as maps of the reduced chi-square, as brightness and shifts over the sensor, over time, and as spectra.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from photonpano.filtering import SYSTEMATIC_PX
from photonpano.geometry import (
    PROJECTIONS,
    Canvas,
    corners,
    inverse,
    nearest_rotations,
    outline_of,
    rescaling,
    transform_points,
)
from photonpano.merging.accumulate import amplitudes_on
from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.record.schema import DetailRecord
from photonpano.report.drawing import (
    BAD,
    INK,
    MUTED,
    PAPER,
    SERIES,
    WIDTH_IN,
    Margins,
    add_axes,
    add_time_axis,
    filled,
    jpeg_uri,
    map_of,
    mark_frames,
    mark_logarithmic,
    page_scale,
    plain_figure,
    shrunk,
    svg_of,
    svg_path,
)
from photonpano.residuals.block_sums import BLOCK_PX, M, R
from photonpano.residuals.detail import REAL
from photonpano.residuals.halves import Halves
from photonpano.residuals.measure import Residuals
from photonpano.values import FloatArray, FluxImage, Group, Light, SpanResiduals, true_spans

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Box = tuple[float, float, float, float]  # left, top, right, bottom

MAX_INSTANTS = 1500  # maximum number of instants at which a trajectory is drawn

_PATH_PIXELS = 1000  # longer side of the picture below the path
_MAX_PARTS = 5  # maximum number of parts of a motion graph with a row of their own

STAGE_NAMES = {"resample": "re-sample", "merge": "merge", "locate": "locate", "interpolate": "interpolate"}


def path_over_time(motion: FrameMotion, frame_rate_hz: float | None) -> str:
    """Draw the position and the speed of the frame centre, and the expected corner error, over time."""
    instants = instants_of(len(motion.homographies))
    path, unit = _path(motion, instants)
    with plain_figure(WIDTH_IN, 6.0) as figure:
        position, speed, error = add_axes(figure, Margins(right=0.3, top=0.55), rows=(3, 2, 2), share_x=True)
        for values, name, colour in zip(path.T, ("x", "y"), SERIES, strict=False):
            position.plot(instants, values, color=colour)
            end = instants[-1], values[-1]
            position.annotate(
                name, end, xytext=(6, 0), textcoords="offset points", va="center", color=colour, fontweight="bold"
            )
        position.set_ylabel(f"frame centre ({unit})")
        if len(instants) > 1:
            steps = np.linalg.norm(np.diff(path, axis=0), axis=1) / np.diff(instants)
            speed.plot((instants[:-1] + instants[1:]) / 2, steps, color=SERIES[2])
        speed.set_ylim(bottom=0)
        speed.set_ylabel(f"speed ({unit}/frame)")
        known = np.where(np.isfinite(motion.std_px), motion.std_px, np.nan)
        error.plot(instants, known[instants], color=INK)
        mark_logarithmic(error)
        error.set_ylabel("expected error (px)")
        mark_frames(error, 0, len(motion.homographies))
        for axes in (position, speed, error):
            for span in true_spans(~motion.located):
                axes.axvspan(span.start - 0.5, span.stop - 0.5, color=MUTED, alpha=0.18, linewidth=0)
        if frame_rate_hz is not None and len(instants) > 1:
            add_time_axis(position, len(motion.homographies), frame_rate_hz)
        return svg_of(figure, "path-over-time")


def path_on_panorama(motion: FrameMotion, panorama: RenderedPanorama) -> str:
    """Draw the path of the frame centre over the panorama, with the outlines of the first, the reference and the last frame."""
    instants = instants_of(len(motion.homographies))
    path = places_on(panorama, motion.homographies[instants], centre_of(motion.frame_shape))[:, 0]
    height, width = panorama.picture.shape[:2]
    scale = page_scale((height, width))

    def drawn(points: FloatArray) -> str:
        """Return the SVG of a path, with a gap where it leaves the picture at one side and comes back at the other."""
        points = points[np.isfinite(points).all(axis=1)]
        jumps = 1 + np.flatnonzero(np.abs(np.diff(points[:, 0])) > width / 2)
        return " ".join(svg_path(scale * (part + 0.5)) for part in np.split(points, jumps) if len(part))

    def outline(index: int) -> str:
        [border] = places_on(panorama, motion.homographies[index, None], outline_of(motion.frame_shape))
        return drawn(np.vstack([border, border[:1]]))

    return filled(
        "path.html",
        size=(scale * width, scale * height),
        picture=jpeg_uri(shrunk(panorama.picture, _PATH_PIXELS)),
        reference=outline(motion.reference),
        others=[outline(0), outline(-1)],
        path=drawn(path),
        ends=[("first", *scale * (path[0] + 0.5)), ("last", *scale * (path[-1] + 0.5))],
    )


def _path(motion: FrameMotion, instants: NDArray[np.int64]) -> tuple[FloatArray, str]:
    """Return the path of the frame centre from that of the reference frame, (N, 2), and its unit: degrees of a turn."""
    centre = centre_of(motion.frame_shape)
    if motion.camera is None:
        return transform_points(motion.homographies[instants], centre)[:, 0] - centre[0], "px"
    ahead = motion.camera.directions(centre[0])
    rotations = nearest_rotations(motion.camera.rotations(motion.homographies[instants]))
    points = PROJECTIONS["spherical"].points(rotations @ ahead) - PROJECTIONS["spherical"].points(ahead)
    path = np.degrees(np.unwrap(points, axis=0))
    reference = min(int(np.searchsorted(instants, motion.reference)), len(path) - 1)
    return path - 360 * np.round(path[reference] / 360), "degrees"


def places_on(panorama: RenderedPanorama, homographies: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return where pixels of frames lie on the picture of a panorama: (N, P, 2)."""
    rays = np.append(pixels, np.ones((len(pixels), 1)), axis=1) @ np.swapaxes(
        panorama.canvas.plane_to_rays @ homographies, -1, -2
    )
    places = panorama.canvas.pixels(rays) if not panorama.canvas.planar else rays[..., :2] / rays[..., 2:]
    return (places + 0.5) / panorama.reduction - 0.5


def coverage_map(coverage: FluxImage) -> str:
    """Draw the number of frames that saw each pixel, (H, W) or (H, W, 3), in any colour; unseen pixels are grey."""
    coverage = np.nan_to_num(coverage if coverage.ndim == 2 else coverage.sum(axis=-1))
    seen = np.where(coverage > 0, coverage, np.nan)
    return _in_row(coverage.shape, [_map("frames", seen, "viridis", (0.0, float(coverage.max())), ",.0f")])


def _in_row(shape: tuple[int, int], maps: Sequence[dict[str, Any]], arrows: dict[str, Any] | None = None) -> str:
    """Draw maps over images with a shape beside each other, and arrows."""
    scale = page_scale(shape, len(maps) + (arrows is not None))
    return filled("maps.html", shape=shape, scale=scale, maps=maps, arrows=arrows)


def _map(label: str, values: Any, colours: str, limits: tuple[float, float], numbers: str = ".3g") -> dict[str, Any]:
    """Return a map of an image with numbers at the ends and the middle of its legend."""
    ticks = [(tick, format(tick, numbers)) for tick in np.linspace(*limits, 3)]
    return {"label": label, "ticks": ticks, "box": None, **map_of(values, colours, *limits)}


def tied_parts(groups: Sequence[Group], parts: NDArray[np.integer]) -> str:
    """Draw the exposures of a level over the frames: a row for each part that is tied together, and one for lone exposures.

    `parts` is (N,), the number of the connected component of each exposure, 0 for the largest.
    """
    sizes = np.bincount(parts)
    tied = np.flatnonzero(sizes > 1)[:_MAX_PARTS]
    rows = [(f"part {row + 1}", parts == part, SERIES[0]) for row, part in enumerate(tied)]
    lone, others = sizes[parts] == 1, (sizes[parts] > 1) & ~np.isin(parts, tied)
    rows += [("other parts", others, SERIES[4])] if others.any() else []
    rows += [("alone", lone, BAD)] if lone.any() else []
    with plain_figure(WIDTH_IN, 0.7 + 0.4 * len(rows)) as figure:
        [axes] = add_axes(figure, Margins(left=1.0, right=0.3))
        for row, (_, members, colour) in enumerate(rows):
            spans = [(group.span.start, len(group.span)) for group, member in zip(groups, members, strict=True) if member]
            axes.broken_barh(spans, (row - 0.32, 0.64), facecolors=colour, edgecolor=PAPER, linewidth=0.6)
        axes.set_yticks(range(len(rows)), [name for name, _, _ in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", colors=INK)
        mark_frames(axes, groups[0].span.start, groups[-1].span.stop)
        return svg_of(figure, "tied-parts")


def instants_of(n_frames: int, most: int = MAX_INSTANTS) -> NDArray[np.int64]:
    """Return frames from the first to the last, evenly spaced."""
    return np.unique(np.linspace(0, n_frames - 1, min(n_frames, most)).round().astype(np.int64))


def centre_of(frame_shape: tuple[int, int]) -> FloatArray:
    """Return the centre of a frame: (1, 2)."""
    return np.asarray(corners(frame_shape).mean(axis=0, keepdims=True))


_MAX_DOTS = 500  # maximum number of spans whose shifts are drawn
_SMALLEST_SHIFT_PX = 0.06  # shifts of blocks are drawn if their root mean square exceeds this, and three times their noise
_FEWEST_BLOCKS = 16  # minimum number of blocks per square of the panorama
_FEWEST_SPANS = 16  # minimum number of spans for a spectrum
_WINDOW_SPANS = 512  # maximum window of the spectrum
_CHI2_RANGE = (0.5, 2.0)  # minimum colour range of the reduced chi-square, widened by larger values
_REDUCED_CHI2_TICKS = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_FLICKER_PIXELS = 200  # approximate longer side of flicker maps
_FLICKERS = 0.2  # minimum amplitude with a phase, relative to the largest amplitude
_GAIN_RANGE_PERCENT = 5.0  # minimum colour range of the brightness, to both sides


def chi2_over_panorama(residuals: Residuals, measured: Canvas, canvas: Canvas) -> str:
    """Draw the reduced chi-square of each place of the panorama.

    On its canvas, or on the one on which the residuals were `measured` if that has another projection.
    """
    same = same_projection(measured, canvas)
    shape, onto = (canvas.shape, canvas.transform) if same else (measured.shape, measured.transform)
    cells, box = chi2_cells(residuals, measured, onto)
    return _in_row(shape, [_chi2_map(residuals, cells, box)])


def same_projection(one: Canvas, other: Canvas) -> bool:
    """Return whether two canvases differ by their scale and place only."""
    return one.projection == other.projection and one.horizon is other.horizon


def chi2_cells(residuals: Residuals, measured: Canvas, onto: FloatArray) -> tuple[FloatArray, Box]:
    """Return the reduced chi-square over the panorama, NaN where it was seen too briefly, and its box.

    The box is left, top, right, bottom in the pixels of the canvas with the transform `onto`.
    """
    reduced_chi2 = np.where(residuals.cell_count < _FEWEST_BLOCKS, np.nan, np.nan_to_num(residuals.cell_chi2))
    rows, columns = reduced_chi2.shape
    edges = [[-0.5, -0.5], [columns * BLOCK_PX - 0.5, rows * BLOCK_PX - 0.5]]
    (left, top), (right, bottom) = transform_points(onto @ inverse(measured.transform), edges)
    return reduced_chi2, (float(left), float(top), float(right), float(bottom))


def over_sensor(residuals: Residuals) -> str:
    """Draw the reduced chi-square and the brightness of the blocks of the sensor, and their shifts if these are significant."""
    shifts = significant_shifts(residuals)
    rows, columns = residuals.block_chi2.shape
    box = -0.5, -0.5, columns * BLOCK_PX - 0.5, rows * BLOCK_PX - 0.5
    gain = 100 * _brightness(residuals)
    limit = max(_GAIN_RANGE_PERCENT, float(np.nanmax(np.abs(gain), initial=0)))
    brightness = _map("brightness (%)", gain, "red-blue", (-limit, limit), "+.3g") | {"box": box}
    maps = [_chi2_map(residuals, residuals.block_chi2, box), brightness]
    return _in_row(residuals.frame_shape, maps, None if shifts is None else _arrows(*shifts))


def _arrows(places: FloatArray, shifts: FloatArray) -> dict[str, Any]:
    """Return arrows, whose usual length is that of a block and a half."""
    usual = float(np.quantile(np.linalg.norm(shifts, axis=1), 0.95))
    length = 1.5 * BLOCK_PX
    return {"length": length, "shift": usual, "ends": np.stack([places, places + length / usual * shifts], axis=1)}


def shifts_over_time(residuals: Residuals, frame_rate_hz: float | None) -> str:
    """Draw the shifts of short spans beyond the motion with the scatter that noise explains, and their spectrum."""
    found = residuals.steps()
    steps, stds = found.steps[:, :2], _noise_px(found)
    with plain_figure(WIDTH_IN, 5.2) as figure:
        time, spectrum = add_axes(figure, Margins(top=0.35), rows=(1, 1), gap_in=0.6)
        shown = np.unique(np.linspace(0, len(steps) - 1, min(len(steps), _MAX_DOTS)).round().astype(int))
        instants, band = residuals.instants[shown], 2 * stds[shown].max(axis=1)
        band = np.where(np.isfinite(band), band, np.nan)
        time.fill_between(instants, -band, band, color=MUTED, alpha=0.25, linewidth=0)
        for values, name, colour in zip(steps[shown].T, ("x", "y"), SERIES, strict=False):
            _draw_dots(time, instants, values, colour)
            time.plot([], [], "o", color=colour, markersize=4, label=name)
        limit = float(np.nanquantile(np.abs(np.c_[steps[shown], 1.5 * band]), 0.995))
        time.set_ylim(-1.1 * limit, 1.1 * limit)
        mark_frames(time, 0, residuals.spans[-1].stop)
        time.set_ylabel("shift (px)")
        time.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, handletextpad=0.2, columnspacing=1.2)
        _draw_spectrum(spectrum, residuals, frame_rate_hz)
        return svg_of(figure, "shifts")


def halves_over_time(halves: Halves, n_frames: int) -> str | None:
    """Draw how the frames before and after each instant agree, and how well they are tied; None for short captures."""
    cuts, stretches = halves.cuts, halves.stretches
    if not len(cuts.firsts):
        return None
    with plain_figure(WIDTH_IN, 4.6) as figure:
        agree, tie = add_axes(figure, Margins(), rows=(1, 1), gap_in=0.85)
        lacking, band = 100 * (cuts.coherence - 1), 200 * cuts.std_coherence
        agree.fill_between(cuts.firsts, lacking - band, lacking + band, color=MUTED, alpha=0.25, linewidth=0)
        agree.axhline(0, color=MUTED, linewidth=1, linestyle="--")
        agree.plot(cuts.firsts, lacking, "o-", color=SERIES[0], markersize=4)
        agree.yaxis.set_major_formatter("{x:g}")
        agree.locator_params(axis="y", nbins=4)
        agree.set_ylabel("coherence - 1 (%)")
        for values, name, colour in zip(cuts.std_px.T[::-1], ("least known direction", "best known"), SERIES, strict=False):
            tie.plot(cuts.firsts, values, color=colour, label=name)
        edges = np.append(stretches.firsts, n_frames)
        tie.stairs(stretches.std_px[:, 1], edges, baseline=None, color=MUTED, label="stretch, least known")
        mark_logarithmic(tie)
        tie.set_ylabel("error across (px)")
        tie.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, columnspacing=1.2)
        for axes in (agree, tie):
            mark_frames(axes, 0, n_frames)
        return svg_of(figure, "halves")


def detail_over_frequency(detail: DetailRecord | None) -> str | None:
    """Draw how the halves of the frames correlate by spatial frequency, and what that says of all; None if it is not known."""
    if not detail:
        return None
    with plain_figure(WIDTH_IN, 2.6) as figure:
        [axes] = add_axes(figure, Margins(top=0.35))
        axes.axhline(REAL, color=MUTED, linewidth=1, linestyle="--")
        axes.plot(detail["frequencies"][1:], detail["scene"][1:], color=SERIES[0], label="all frames and the scene")
        axes.plot(detail["frequencies"][1:], detail["halves"][1:], color=SERIES[1], label="both halves")
        if detail["finest_px"] is not None:
            axes.axvline(1 / detail["finest_px"], color=MUTED, linewidth=1, linestyle="--")
        axes.set(xlim=(0, detail["frequencies"][-1]), ylim=(-0.1, 1.05), xlabel="periods per px", ylabel="correlation")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, columnspacing=1.2)
        return svg_of(figure, "detail")


def light_over_time(residuals: Residuals) -> str | None:
    """Draw the gain of the light of the spans; None in steady light."""
    gain = residuals.light
    if np.ptp(gain) == 0:
        return None
    with plain_figure(WIDTH_IN, 2.4) as figure:
        [axes] = add_axes(figure, Margins())
        axes.axhline(1, color=MUTED, linewidth=1, linestyle="--")
        axes.plot(residuals.instants, gain, color=SERIES[0])
        mark_frames(axes, 0, residuals.spans[-1].stop)
        axes.set_ylim(0, 1.05 * float(gain.max()))
        axes.set_ylabel("light / mean")
        return svg_of(figure, "light")


def flicker_over_panorama(light: Light | None, canvas: Canvas) -> str | None:
    """Draw how deep each place flickers, and at which phase; None if all of the scene has the same light."""
    if light is None or not light.has_lamps:
        return None
    shape = canvas.shape
    step = max(1, max(shape) // _FLICKER_PIXELS)
    small = -(-shape[0] // step), -(-shape[1] // step)
    coarse = replace(canvas, height=small[0], width=small[1], transform=rescaling(1 / step) @ canvas.transform)
    cosine, sine = amplitudes_on(light, coarse)
    box = -0.5, -0.5, small[1] * step - 0.5, small[0] * step - 0.5
    depth = np.hypot(cosine, sine)
    deepest = float(depth.max())
    # Places that hardly flicker have no phase.
    phase = np.where(depth < _FLICKERS * deepest, np.nan, np.degrees(np.arctan2(-sine, cosine)))
    maps = [
        _map("flicker / mean light", depth, "viridis", (0.0, deepest)),
        _map("phase (degrees)", phase, "twilight", (-180.0, 180.0)),
    ]
    return _in_row(shape, [each | {"box": box} for each in maps])


def spectrum_over_noise(residuals: Residuals) -> tuple[FloatArray, FloatArray]:
    """Return the power spectrum of the shifts of short spans, divided by that of their photon noise.

    It is the mean of windows that overlap by half, and of both directions (Welch 1967). The mean shift is left out: it moves
    the whole panorama. Returns (F,) frequencies in cycles per frame, and (F,) power; both empty for fewer than 16 spans.
    """
    found = residuals.steps()
    stds = _noise_px(found)
    ratios = np.where(np.isfinite(stds), found.steps[:, :2] / stds, 0)
    if len(ratios) < _FEWEST_SPANS:
        return np.zeros(0), np.zeros(0)
    ratios = ratios - ratios.mean(axis=0)
    size = min(_WINDOW_SPANS, len(ratios))
    taper = np.hanning(size + 2)[1:-1, None]
    starts = range(0, len(ratios) - size + 1, max(1, size // 2))
    windows = np.stack([ratios[start : start + size] * taper for start in starts])
    power = (np.abs(np.fft.rfft(windows, axis=1)) ** 2).mean(axis=(0, 2)) / (taper**2).sum()
    step = float(np.median(np.diff(residuals.instants)))
    return np.asarray(np.fft.rfftfreq(size, step)[1:], np.float64), np.asarray(power[1:], np.float64)


def significant_shifts(residuals: Residuals) -> tuple[FloatArray, FloatArray] | None:
    """Return places and shifts of the blocks of the sensor, (N, 2) each in px; None if noise explains the shifts."""
    field, information = residuals.block_shifts()
    with np.errstate(divide="ignore"):
        noise = np.sqrt(1 / np.linalg.eigvalsh(information).clip(min=0)[..., 0])
    length = np.linalg.norm(field, axis=-1)
    known = noise < np.maximum(_SMALLEST_SHIFT_PX, length / 2)
    if not known.any() or np.sqrt(np.mean(length[known] ** 2)) < max(_SMALLEST_SHIFT_PX, 3 * float(np.median(noise[known]))):
        return None
    height, width = residuals.frame_shape
    y, x = np.nonzero(known)
    ends = np.minimum((y + 1) * BLOCK_PX, height), np.minimum((x + 1) * BLOCK_PX, width)
    places = np.stack([(x * BLOCK_PX + ends[1] - 1) / 2, (y * BLOCK_PX + ends[0] - 1) / 2], axis=-1)
    return places, field[known]


def _chi2_map(residuals: Residuals, reduced_chi2: FloatArray, box: Box) -> dict[str, Any]:
    """Return a map in one logarithmic scale of colours for all maps of it, as noise is near 1 and a moving thing at 100."""
    drawn = np.r_[residuals.cell_chi2[residuals.cell_count >= _FEWEST_BLOCKS], residuals.block_chi2.ravel()]
    drawn = drawn[np.isfinite(drawn)]
    low, high = _CHI2_RANGE[0], max(_CHI2_RANGE[1], float(np.quantile(drawn, 0.99)) if len(drawn) else 0.0)
    ticks = [(np.log(tick), f"{tick:g}") for tick in _REDUCED_CHI2_TICKS if low <= tick <= high]
    colours = map_of(np.log(np.maximum(reduced_chi2, low)), "inferno", float(np.log(low)), float(np.log(high)))
    return {"label": "reduced chi-square", "ticks": ticks, "box": box, **colours}


def _brightness(residuals: Residuals) -> FloatArray:
    """Return the relative excess of photons of each block of the sensor: (h, w), NaN where nothing was predicted."""
    predicted = residuals.blocks[..., M]
    gain: FloatArray = np.full(predicted.shape, np.nan)
    np.divide(residuals.blocks[..., R], predicted, out=gain, where=predicted > 0)
    return gain


def _noise_px(found: SpanResiduals) -> FloatArray:
    """Return the standard deviation of the shifts along x and y that noise and interpolation explain: (S, 2)."""
    return np.asarray(np.sqrt(found.variances[:, :2] + SYSTEMATIC_PX**2))


def _draw_dots(axes: Axes, x: FloatArray, y: FloatArray, colour: str) -> None:
    """Draw dots as one path of short dashes, which takes a tenth of the bytes of markers."""
    dash = float(np.ptp(x)) / 1e4 if len(x) > 1 else 0.1
    xs, ys = np.stack([x, x + dash, np.full_like(x, np.nan)], axis=1), np.stack([y, y, np.full_like(y, np.nan)], axis=1)
    axes.plot(xs.ravel(), ys.ravel(), color=colour, linewidth=3.0)


def _draw_spectrum(axes: Axes, residuals: Residuals, frame_rate_hz: float | None) -> None:
    frequencies, power = spectrum_over_noise(residuals)
    scale, label = (1.0, "frequency (cycles per frame)") if frame_rate_hz is None else (frame_rate_hz, "frequency (Hz)")
    axes.axhline(1, color=MUTED, linewidth=1, linestyle="--")
    if len(frequencies):
        axes.plot(scale * frequencies, power, color=SERIES[2])
        axes.set_xlim(0, scale * frequencies[-1])
        axes.set_yscale("log")
        axes.set_ylim(min(0.2, 0.8 * float(power.min())), max(10.0, 1.5 * float(power.max())))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
    axes.xaxis.set_major_formatter("{x:,g}")
    axes.set_xlabel(label)
    axes.set_ylabel("power / noise")
