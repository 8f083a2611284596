"""Figures of the residuals: maps of the reduced chi-square, brightness and shifts over the sensor, spectra."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano.filtering import SYSTEMATIC_PX
from photonpano.geometry import Canvas, inverse, rescaling, transform_points
from photonpano.merging.light import amplitudes_on
from photonpano.report.drawing import (
    BAR_IN,
    INK,
    LINE,
    MUTED,
    SERIES,
    WIDTH_IN,
    Margins,
    add_axes,
    add_colour_bar,
    extent_of,
    map_figure,
    maps_figure,
    mark_frames,
    plain_figure,
    svg_of,
)
from photonpano.residuals.block_sums import BLOCK_PX, M, R
from photonpano.residuals.halves import Halves
from photonpano.residuals.measure import Residuals
from photonpano.values import FloatArray, Light, SpanResiduals

if TYPE_CHECKING:  # importing matplotlib takes a second
    from matplotlib.axes import Axes

MAX_DOTS = 500  # maximum number of spans whose shifts are drawn
SMALLEST_SHIFT_PX = 0.06  # shifts of blocks are drawn if their root mean square exceeds this, and three times their noise
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
    reduced_chi2, (left, top, right, bottom) = chi2_cells(residuals, measured, onto)
    with map_figure(*shape, side_in=BAR_IN) as (figure, axes):
        axes.set_facecolor(LINE)
        extent = left, right, bottom, top
        image = axes.imshow(reduced_chi2, **_chi2_colours(residuals), extent=extent, interpolation="nearest")
        axes.set_xlim(-0.5, shape[1] - 0.5)
        axes.set_ylim(shape[0] - 0.5, -0.5)
        _add_colour_bar(axes, image, "reduced chi-square")
        return svg_of(figure, "chi2-panorama")


def same_projection(one: Canvas, other: Canvas) -> bool:
    """Return whether two canvases differ by their scale and place only."""
    return one.projection == other.projection and one.horizon is other.horizon


def chi2_cells(residuals: Residuals, measured: Canvas, onto: FloatArray) -> tuple[Any, tuple[float, float, float, float]]:
    """Return the reduced chi-square over the panorama, masked where it was seen too briefly, and its box.

    The box is left, top, right, bottom in the pixels of the canvas with the transform `onto`.
    """
    reduced_chi2 = np.ma.masked_where(residuals.cell_count < _FEWEST_BLOCKS, np.nan_to_num(residuals.cell_chi2))
    rows, columns = reduced_chi2.shape
    edges = [[-0.5, -0.5], [columns * BLOCK_PX - 0.5, rows * BLOCK_PX - 0.5]]
    (left, top), (right, bottom) = transform_points(onto @ inverse(measured.transform), edges)
    return reduced_chi2, (float(left), float(top), float(right), float(bottom))


def over_sensor(residuals: Residuals) -> str:
    """Draw the reduced chi-square and the brightness of the blocks of the sensor, and their shifts if these are significant."""
    height, width = residuals.frame_shape
    shifts = significant_shifts(residuals)
    with maps_figure(height, width, 2 if shifts is None else 3) as (figure, maps):
        extent = extent_of(*(BLOCK_PX * n_blocks for n_blocks in residuals.block_chi2.shape))
        reduced_chi2 = np.ma.masked_invalid(residuals.block_chi2)
        image = maps[0].imshow(reduced_chi2, **_chi2_colours(residuals), extent=extent, interpolation="nearest")
        _add_colour_bar(maps[0], image, "reduced chi-square")
        gain = np.ma.masked_invalid(100 * _brightness(residuals))
        limit = max(_GAIN_RANGE_PERCENT, float(np.abs(gain).max())) if gain.count() else _GAIN_RANGE_PERCENT
        image = maps[1].imshow(gain, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=extent, interpolation="nearest")
        _add_colour_bar(maps[1], image, "brightness (%)", "{x:+.3g}")
        if shifts is not None:
            _draw_shifts(maps[2], shifts)
        return svg_of(figure, "sensor")


def shifts_over_time(residuals: Residuals, frame_rate_hz: float | None) -> str:
    """Draw the shifts of short spans beyond the motion with the scatter that noise explains, and their spectrum."""
    found = residuals.steps()
    steps, stds = found.steps[:, :2], _noise_px(found)
    with plain_figure(WIDTH_IN, 5.2) as figure:
        time, spectrum = add_axes(figure, Margins(top=0.35), rows=(1, 1), gap_in=0.6)
        shown = np.unique(np.linspace(0, len(steps) - 1, min(len(steps), MAX_DOTS)).round().astype(int))
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
    with plain_figure(WIDTH_IN, 4.4) as figure:
        agree, tie = add_axes(figure, Margins(top=0.35), rows=(1, 1), gap_in=0.6)
        band = 2 * cuts.std_coherence
        agree.fill_between(cuts.firsts, cuts.coherence - band, cuts.coherence + band, color=MUTED, alpha=0.25, linewidth=0)
        agree.axhline(1, color=MUTED, linewidth=1, linestyle="--")
        agree.plot(cuts.firsts, cuts.coherence, "o-", color=SERIES[0], markersize=4)
        agree.set_ylabel("coherence")
        for values, name, colour in zip(cuts.std_px.T[::-1], ("least known direction", "best known"), SERIES, strict=False):
            tie.semilogy(cuts.firsts, values, color=colour, label=name)
        edges = np.append(stretches.firsts, n_frames)
        tie.stairs(stretches.std_px[:, 1], edges, baseline=None, color=MUTED, label="stretch, least known")
        tie.set_ylabel("error across (px)")
        tie.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, columnspacing=1.2)
        for axes in (agree, tie):
            mark_frames(axes, 0, n_frames)
        return svg_of(figure, "halves")


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
    extent = -0.5, small[1] * step - 0.5, small[0] * step - 0.5, -0.5
    depth = np.hypot(cosine, sine)
    with maps_figure(*shape, 2) as (figure, (left, right)):
        image = left.imshow(depth, cmap="viridis", vmin=0, extent=extent)
        _add_colour_bar(left, image, "flicker / mean light")
        # Places that hardly flicker have no phase.
        phase = np.ma.masked_where(depth < _FLICKERS * depth.max(), np.degrees(np.arctan2(-sine, cosine)))
        image = right.imshow(phase, cmap="twilight", vmin=-180, vmax=180, extent=extent)
        _add_colour_bar(right, image, "phase (degrees)")
        return svg_of(figure, "flicker")


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
    known = noise < np.maximum(SMALLEST_SHIFT_PX, length / 2)
    if not known.any() or np.sqrt(np.mean(length[known] ** 2)) < max(SMALLEST_SHIFT_PX, 3 * float(np.median(noise[known]))):
        return None
    height, width = residuals.frame_shape
    y, x = np.nonzero(known)
    ends = np.minimum((y + 1) * BLOCK_PX, height), np.minimum((x + 1) * BLOCK_PX, width)
    places = np.stack([(x * BLOCK_PX + ends[1] - 1) / 2, (y * BLOCK_PX + ends[0] - 1) / 2], axis=-1)
    return places, field[known]


def _chi2_colours(residuals: Residuals) -> dict[str, Any]:
    """Return one logarithmic scale of colours for all maps of it, as noise is near 1 and a moving thing at 100."""
    from matplotlib.colors import LogNorm

    drawn = np.r_[residuals.cell_chi2[residuals.cell_count >= _FEWEST_BLOCKS], residuals.block_chi2.ravel()]
    drawn = drawn[np.isfinite(drawn)]
    high = float(np.quantile(drawn, 0.99)) if len(drawn) else 0.0
    return {"cmap": "inferno", "norm": LogNorm(_CHI2_RANGE[0], max(_CHI2_RANGE[1], high))}


def _brightness(residuals: Residuals) -> FloatArray:
    """Return the relative excess of photons of each block of the sensor: (h, w), NaN where nothing was predicted."""
    predicted = residuals.blocks[..., M]
    gain: FloatArray = np.full(predicted.shape, np.nan)
    np.divide(residuals.blocks[..., R], predicted, out=gain, where=predicted > 0)
    return gain


def _noise_px(found: SpanResiduals) -> FloatArray:
    """Return the standard deviation of the shifts along x and y that noise and interpolation explain: (S, 2)."""
    return np.asarray(np.sqrt(found.variances[:, :2] + SYSTEMATIC_PX**2))


def _add_colour_bar(axes: Axes, image: Any, label: str, numbers: str = "{x:.3g}") -> None:
    bar = add_colour_bar(axes, image, label, numbers)
    if image.norm.vmin > 0:
        bar.set_ticks([tick for tick in _REDUCED_CHI2_TICKS if image.norm.vmin <= tick <= image.norm.vmax])
        bar.ax.minorticks_off()


def _draw_shifts(axes: Axes, shifts: tuple[FloatArray, FloatArray]) -> None:
    """Draw arrows, as long as a block for the longest, and one of a known length."""
    places, field = shifts
    typical = float(np.quantile(np.linalg.norm(field, axis=1), 0.95))
    arrows = axes.quiver(
        *places.T, *field.T, color=SERIES[1], angles="xy", scale_units="xy", scale=typical / (1.5 * BLOCK_PX), width=0.006
    )
    axes.quiverkey(arrows, 0.5, 1.08, typical, f"{typical:.2g} px", labelpos="E", coordinates="axes", labelcolor=INK)
    axes.set_facecolor("none")


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
        axes.yaxis.set_minor_formatter("")
        axes.tick_params(which="minor", length=0)
    axes.xaxis.set_major_formatter("{x:,g}")
    axes.set_xlabel(label)
    axes.set_ylabel("power / noise")
