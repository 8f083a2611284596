"""Render the report of a run with `pose`: the path of the camera and the points, each seen from two sides.

Convention: The world is that of the poses, X_c = R X_w + t. A view has axes to the right, up and towards the viewer; what is
shown is projected onto a plane through its middle.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano import FloatArray
from photonpano.geometry import nearest_rotations, positions_of
from photonpano.photometry import linear_to_srgb
from photonpano.record.picture_files import png_of
from photonpano.report.drawing import (
    INK,
    MUTED,
    SERIES,
    WIDTH_IN,
    Margins,
    add_axes,
    add_time_axis,
    filled,
    plain_figure,
    svg_of,
)
from photonpano.report.page import head_of
from photonpano_poses.contract import PoseEstimate
from photonpano_poses.files import picture_of

if TYPE_CHECKING:  # importing matplotlib takes a second
    from matplotlib.axes import Axes


def render_pose_report(record: Any, estimate: PoseEstimate) -> str:
    """Return the report of a run with `pose` as one HTML page that needs no other file and no network.

    Only depth needs a script. The path of the estimate has the length 1.
    """
    shape = record["source"]["height"], record["source"]["width"]
    return filled(
        "poses.html",
        "photonpano_poses",
        **head_of(record),
        poses=record["poses"],
        path_views=path_views(estimate, shape),
        scene_views=scene_views(estimate, shape) if len(estimate.points.positions) else (),
        errors_over_time=errors_over_time(estimate, record["source"]["frame_rate_hz"]),
        depth_source=depth_source(estimate),
    )


def depth_source(estimate: PoseEstimate) -> str | None:
    """Return a PNG as a `data:` URL: the depth map in the middle as it is seen, and below its inverse depth, 0 where unknown.

    None if no pixel has a depth.
    """
    maps = [each for each in estimate.depth if np.isfinite(each.inverse_depth).any()]
    if not maps:
        return None
    middle = maps[len(maps) // 2]
    q, known = middle.inverse_depth, np.isfinite(middle.inverse_depth)
    low, high = np.quantile(q[known], _NEAR_QUANTILES)
    levels = np.clip(1 + 254 * (q - low) / max(high - low, 1e-12), 1, 255)
    near = np.where(known, levels, 0).astype(np.uint8)
    return "data:image/png;base64," + b64encode(png_of(np.concatenate([picture_of(middle.flux), near]))).decode()


MAX_ERRORS = 2000  # frames whose expected errors are drawn; of more, every nth


def errors_over_time(estimate: PoseEstimate, frame_rate_hz: float | None) -> str | None:
    """Draw the expected errors of position and rotation over time; None if the estimator knows neither."""
    stds = [np.where(np.isfinite(std), std, np.nan) for std in (100 * estimate.std_position, estimate.std_rotation_deg)]
    if not any(np.isfinite(std).any() for std in stds):
        return None
    n_frames = len(estimate.located)
    frames = np.arange(0, n_frames, -(-n_frames // MAX_ERRORS))
    top = 0.1 if frame_rate_hz is None else 0.55
    with plain_figure(WIDTH_IN, 3.6) as figure:
        rows = add_axes(figure, Margins(top=top), rows=(1, 1), share_x=True)
        for axes, std, label, colour in zip(rows, stds, ("position (%)", "rotation (°)"), SERIES, strict=False):
            axes.plot(frames, std[frames], color=colour)
            axes.set_ylim(0, 1.15 * float(np.nanmax(std, initial=1e-9)))
            axes.set_ylabel(label)
        rows[-1].set_xlabel("frame")
        rows[-1].set_xlim(0, max(1, n_frames - 1))
        if frame_rate_hz is not None:
            add_time_axis(rows[0], n_frames, frame_rate_hz)
        return svg_of(figure, "pose-errors")


MAX_POINTS = 20_000  # points that are drawn; of more, every nth
MAX_FRAMES = 500  # frames of the path that are drawn; of more, every nth
FRUSTUMS = 14
_SIZE_IN = 5.0, 4.4
_DOTS_PER_INCH = 150  # resolution of the points, which are drawn as pixels: shapes would make the page ten times as large
# Colours of the path from its start to its end, which show on light and on dark paper.
_TIME = "#3d7ec6", "#9a5fb8", "#d9662a"
# Background and text of the views of points, which are shown with their own brightness.
_NIGHT, _ON_NIGHT = "#101316", "#c9d0d6"
_DARKEST = 0.25  # grey level of a dark point, brighter than the background
_NEAR_QUANTILES = 0.02, 0.98  # quantiles of the points that the view is fitted to: a few points lie very far away
_TILT = 0.4  # tilt of a viewpoint from its principal axis, up and back, which makes depth visible
_STEEP = 0.8  # minimum cosine of the angle to the vertical of a view from above
_AWAY = 3.5  # distance of the viewer from the middle, relative to the radius of what is shown
_CLOSEST = 0.2  # minimum distance of a point from the viewer, relative to that of the middle
_MARGIN = 0.12
_FRUSTUM = 0.14  # depth of a camera's frustum, relative to the radius of what is shown


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """A place to look from at `middle`, from the side `name`, such as "from above"."""

    axes: FloatArray  # (3, 3) rows to the right, up, and towards the viewer, in the world
    middle: FloatArray
    distance: float  # of the viewer from the middle
    name: str

    def project(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where places (N, 3) appear on the plane through the middle, (N, 2), and how much larger than there, (N,).

        Those close to the viewer or behind are NaN.
        """
        seen = (places - self.middle) @ self.axes.T
        left = self.distance - seen[:, 2]
        larger = self.distance / np.where(left > _CLOSEST * self.distance, left, np.nan)
        return seen[:, :2] * larger[:, None], larger


def viewpoints(shown: FloatArray, poses: FloatArray) -> tuple[Viewpoint, Viewpoint]:
    """Choose two places from which things spread widely: along their least and their second principal axis, from aslant.

    `shown` is (N, 3); the poses (T, 3, 4) of located cameras give the directions up and ahead.
    """
    low, high = np.min(shown, axis=0), np.max(shown, axis=0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(shown - middle, axis=1).max()) or 1.0
    principal = np.linalg.eigh(np.cov(shown.T))[1].T  # the least first
    right, down, ahead = nearest_rotations(poses[:, :, :3].mean(axis=0))
    least, second = (
        _viewpoint(axis, right, -down, ahead=ahead, middle=middle, distance=_AWAY * radius) for axis in principal[:2]
    )
    return least, second


def path_views(estimate: PoseEstimate, shape: tuple[int, int]) -> tuple[str, str]:
    """Draw the path of the camera, coloured by time, with its frustums; frames have the given height and width."""
    poses = estimate.camera_from_world[estimate.located]
    first, second = viewpoints(positions_of(poses), poses)
    return _path_view(estimate, shape, first, "path-1"), _path_view(estimate, shape, second, "path-2")


def scene_views(estimate: PoseEstimate, shape: tuple[int, int]) -> tuple[str, str]:
    """Draw the points with the flux in which they were seen, the path of the camera, and some frustums."""
    poses, points = estimate.camera_from_world[estimate.located], estimate.points.positions
    low, high = np.quantile(points, _NEAR_QUANTILES, axis=0)
    near = points[((points >= low) & (points <= high)).all(axis=1)]
    shown = np.concatenate([near, positions_of(poses)])
    first, second = viewpoints(shown, poses)
    return _scene_view(estimate, shape, first, shown, "scene-1"), _scene_view(estimate, shape, second, shown, "scene-2")


def _viewpoint(
    axis: FloatArray, right: FloatArray, up: FloatArray, *, ahead: FloatArray, middle: FloatArray, distance: float
) -> Viewpoint:
    """Look along an axis, from the side that is above and behind the cameras."""
    side = axis if axis @ (up - ahead) >= 0 else -axis
    towards = side + _TILT * (up - ahead)
    towards /= np.linalg.norm(towards)
    # Seen from above, what is ahead is up, as on a map.
    upwards = ahead if abs(up @ towards) > _STEEP else up
    upwards = upwards - (upwards @ towards) * towards
    upwards /= np.linalg.norm(upwards)
    along = {"above": up, "below": -up, "behind": -ahead, "ahead": ahead, "the right": right, "the left": -right}
    name = max(along, key=lambda name: float(along[name] @ side))
    return Viewpoint(np.array([np.cross(upwards, towards), upwards, towards]), middle, distance, f"from {name}")


def _path_view(estimate: PoseEstimate, shape: tuple[int, int], viewpoint: Viewpoint, name: str) -> str:
    places = positions_of(estimate.camera_from_world[estimate.located])
    frustums = _frustums(estimate, shape, _FRUSTUM * viewpoint.distance / _AWAY)
    with plain_figure(*_SIZE_IN) as figure:
        axes: Axes = figure.add_axes((0, 0, 1, 1))
        _draw_path(axes, estimate, viewpoint, frustums, INK)
        corners = np.concatenate([places, *(corners for _, corners in frustums)])
        _finish(axes, viewpoint, viewpoint.project(corners)[0], INK, MUTED)
        return svg_of(figure, name)


def _scene_view(estimate: PoseEstimate, shape: tuple[int, int], viewpoint: Viewpoint, shown: FloatArray, name: str) -> str:
    points, flux = estimate.points.positions, estimate.points.flux
    step = max(1, -(-len(points) // MAX_POINTS))
    points, flux = points[::step], flux[::step]
    with plain_figure(*_SIZE_IN) as figure:
        figure.set_dpi(_DOTS_PER_INCH)
        figure.set_facecolor(_NIGHT)
        axes: Axes = figure.add_axes((0, 0, 1, 1))
        xy, larger = viewpoint.project(points)
        far_to_near = np.argsort(larger)
        far_to_near = far_to_near[np.isfinite(larger[far_to_near])]
        levels = np.repeat(_levels(flux)[far_to_near, None], 3, axis=1)
        size = np.clip(6000 / len(points), 2.0, 12.0)
        sizes = size * np.minimum(larger[far_to_near], 2) ** 2
        x, y = xy[far_to_near].T
        axes.scatter(x, y, s=sizes, c=levels, linewidths=0, rasterized=True)
        frustums = _frustums(estimate, shape, _FRUSTUM / 2 * viewpoint.distance / _AWAY)
        _draw_path(axes, estimate, viewpoint, frustums[:: len(frustums) - 1], _ON_NIGHT)
        _finish(axes, viewpoint, viewpoint.project(shown)[0], _ON_NIGHT, _ON_NIGHT)
        return svg_of(figure, name)


def _levels(flux: Any) -> FloatArray:
    """Return grey levels of points (N,) from `_DARKEST` to 1, sRGB; one without a flux is dark."""
    known = flux[np.isfinite(flux)]
    white = float(np.quantile(known, 0.98)) if known.size else 1.0
    srgb = linear_to_srgb(np.clip(np.nan_to_num(flux) / max(white, 1e-9), 0, 1).astype(np.float32))
    return np.asarray(_DARKEST + (1 - _DARKEST) * srgb, np.float64)


def _frustums(estimate: PoseEstimate, shape: tuple[int, int], depth: float) -> list[tuple[float, FloatArray]]:
    """Return for some cameras the time, from 0 to 1, and the corners (5, 3) of a frustum: its apex, then those of the image."""
    frames = np.flatnonzero(estimate.located)
    chosen = np.unique(frames[np.linspace(0, len(frames) - 1, FRUSTUMS).round().astype(int)])
    (height, width), last = shape, max(1, len(estimate.located) - 1)
    pixels = np.array([(x, y, 1.0) for x, y in ((0, 0), (width, 0), (width, height), (0, height))]) - (0.5, 0.5, 0)
    rays = depth * pixels @ np.linalg.inv(estimate.camera_matrix).T
    corners = np.concatenate([np.zeros((1, 3)), rays])
    return [
        (frame / last, (corners - pose[:, 3]) @ pose[:, :3])
        for frame, pose in zip(chosen.tolist(), estimate.camera_from_world[chosen], strict=True)
    ]


def _draw_path(
    axes: Axes, estimate: PoseEstimate, viewpoint: Viewpoint, frustums: list[tuple[float, FloatArray]], ink: str
) -> None:
    """Draw the path and frustums in the colours of time, and name the first and the last located frame."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("time", _TIME)
    n_frames = len(estimate.located)
    frames = np.unique(np.append(np.arange(0, n_frames, -(-n_frames // MAX_FRAMES)), n_frames - 1))
    xy, _ = viewpoint.project(positions_of(estimate.camera_from_world[frames]))
    steps = np.stack([xy[:-1], xy[1:]], axis=1)
    known = np.isfinite(steps).all(axis=(1, 2))
    times = frames[:-1] / max(1, n_frames - 1)
    axes.add_collection(LineCollection(list(steps[known]), colors=colours(times[known]), linewidths=2.4))
    for time, corners in frustums:
        apex, *image = viewpoint.project(corners)[0]
        edges = [np.array([*image, image[0]]), *(np.array([apex, corner]) for corner in image)]
        axes.add_collection(LineCollection(edges, colors=[colours(time)], linewidths=0.9, alpha=0.85))
    first_and_last = np.flatnonzero(estimate.located)[[0, -1]]
    ends, _ = viewpoint.project(positions_of(estimate.camera_from_world[first_and_last]))
    upper = int(np.argmax(ends[:, 1]))
    for number, (frame, end) in enumerate(zip(first_and_last.tolist(), ends, strict=True)):
        axes.plot(*end, "os"[number], color=colours(frame / max(1, n_frames - 1)), markersize=7)
        place: Any = {"xytext": (0, 10), "va": "bottom"} if number == upper else {"xytext": (0, -10), "va": "top"}
        axes.annotate(f"frame {frame:,}", end, **place, textcoords="offset points", ha="center", color=ink)


def _finish(axes: Axes, viewpoint: Viewpoint, shown: FloatArray, ink: str, muted: str) -> None:
    """Fit the axes to what is shown, (N, 2), and write the side, a scale, and the directions of the world."""
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    half = (0.5 + _MARGIN) * np.maximum(high - low, 1e-9)
    aspect = _SIZE_IN[0] / _SIZE_IN[1]
    half_height = max(half[1], half[0] / aspect)
    (x, y), half_width = (low + high) / 2, half_height * aspect
    axes.set_xlim(x - half_width, x + half_width)
    axes.set_ylim(y - half_height, y + half_height)
    axes.set_axis_off()
    axes.text(0.03, 0.97, viewpoint.name, transform=axes.transAxes, ha="left", va="top", color=ink, fontsize=12)
    length = _round_length(0.5 * half_width)
    start = 0.03
    stop = start + length / (2 * half_width)
    axes.plot([start, stop], [0.05, 0.05], transform=axes.transAxes, color=muted, linewidth=2)
    axes.text(start, 0.065, f"{length:g}", transform=axes.transAxes, ha="left", va="bottom", color=muted)
    corner = np.array([0.9, 0.88])
    for label, axis in zip("xyz", viewpoint.axes.T, strict=True):
        tip = corner + 0.055 * axis[:2] * (1, aspect)
        axes.plot(*np.stack([corner, tip], axis=1), transform=axes.transAxes, color=muted, linewidth=1.2)
        if np.linalg.norm(axis[:2]) > 0.25:  # the name of an axis that points at the viewer would lie on the others
            x, y = corner + 0.085 * axis[:2] * (1, aspect)
            axes.text(x, y, label, transform=axes.transAxes, ha="center", va="center", color=muted)


def _round_length(longest: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(power * max(factor for factor in (1, 2, 5) if factor * power <= longest))
