"""The figures of the report: the motion, the coverage, and the time of each stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import PROJECTIONS, corners, nearest_rotations, outline_of, transform_points
from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.record.schema import LevelRecord, PanoramaRecord
from photonpano.report.drawing import (
    BAD,
    BAR_IN,
    INK,
    LINE,
    MAP_PIXELS,
    MUTED,
    PAPER,
    SERIES,
    WIDTH_IN,
    Margins,
    add_axes,
    add_colour_bar,
    add_time_axis,
    extent_of,
    map_figure,
    mark_frames,
    mark_logarithmic,
    plain_figure,
    shrunk,
    svg_of,
)
from photonpano.text import duration
from photonpano.values import FloatArray, FluxImage, Group, true_spans

MAX_INSTANTS = 1500  # maximum number of instants at which a trajectory is drawn

MAX_PARTS = 5  # maximum number of parts of a motion graph with a row of their own

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
    with map_figure(height, width) as (figure, axes):
        picture = shrunk(panorama.picture, MAP_PIXELS)
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, extent=extent_of(height, width), alpha=0.55)
        for index, style in ((motion.reference, "-"), (0, ":"), (-1, ":")):
            outline = places_on(panorama, motion.homographies[index, None], outline_of(motion.frame_shape))[0]
            axes.plot(*_cut_at_seam(np.vstack([outline, outline[:1]]), width).T, color=INK, linewidth=0.9, linestyle=style)
        drawn = _cut_at_seam(path, width)
        axes.plot(*drawn.T, color=PAPER, linewidth=3.5)
        axes.plot(*drawn.T, color=SERIES[1], linewidth=1.6)
        for point, name in ((path[0], "first"), (path[-1], "last")):
            axes.plot(*point, "o", color=SERIES[1], markeredgecolor=PAPER, markersize=7)
            axes.annotate(name, point, xytext=(0, 9), textcoords="offset points", ha="center", fontweight="bold")
        return svg_of(figure, "path-on-panorama")


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


def _cut_at_seam(path: FloatArray, width: int) -> FloatArray:
    """Return a path, (N, 2), with a gap where it leaves the picture at one side and comes back at the other."""
    jumps = 1 + np.flatnonzero(np.abs(np.diff(path[:, 0])) > width / 2)
    return np.insert(path, jumps, np.nan, axis=0)


def coverage_map(coverage: FluxImage) -> str:
    """Draw the number of frames that saw each pixel, (H, W) or (H, W, 3), in any colour; unseen pixels are grey."""
    coverage = coverage if coverage.ndim == 2 else coverage.sum(axis=-1)
    height, width = coverage.shape
    with map_figure(height, width, side_in=BAR_IN) as (figure, axes):
        axes.set_facecolor(LINE)
        small = shrunk(np.nan_to_num(coverage), MAP_PIXELS)
        image = axes.imshow(np.ma.masked_less_equal(small, 0), cmap="viridis", vmin=0, extent=extent_of(height, width))
        add_colour_bar(axes, image, "frames", "{x:,.0f}")
        return svg_of(figure, "coverage")


def tied_parts(groups: Sequence[Group], parts: NDArray[np.integer]) -> str:
    """Draw the exposures of a level over the frames: a row for each part that is tied together, and one for lone exposures.

    `parts` is (N,), the number of the connected component of each exposure, 0 for the largest.
    """
    sizes = np.bincount(parts)
    tied = np.flatnonzero(sizes > 1)[:MAX_PARTS]
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


def stage_times(levels: Sequence[LevelRecord], panorama: PanoramaRecord | None) -> str:
    """Draw the seconds of each stage of each level, and of the panorama."""
    names = [f"level {level['level']}" for level in levels] + (["panorama"] if panorama else [])
    with plain_figure(WIDTH_IN, 0.9 + 0.36 * len(names)) as figure:
        [axes] = add_axes(figure, Margins(right=0.6, top=0.35))
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
        figure.legend(loc="upper left", ncols=5, handlelength=1, handleheight=1, columnspacing=1.4)
        return svg_of(figure, "stage-times")


def instants_of(n_frames: int, most: int = MAX_INSTANTS) -> NDArray[np.int64]:
    """Return frames from the first to the last, evenly spaced."""
    return np.unique(np.linspace(0, n_frames - 1, min(n_frames, most)).round().astype(np.int64))


def centre_of(frame_shape: tuple[int, int]) -> FloatArray:
    """Return the centre of a frame: (1, 2)."""
    return np.asarray(corners(frame_shape).mean(axis=0, keepdims=True))
