"""Merge frames along the path of the camera, through the depth of the scene, which is interpolated between points."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import cKDTree

from photonpano import FloatArray, FrameSpan, Group, Source, VirtualExposure, capture_of
from photonpano.compiling import compiled
from photonpano.geometry import Camera, inverse, scaled_ahead
from photonpano.merging import PhotonSum, chunks_of
from photonpano_colmap.posing.lens import Lens, imaged, lens_of
from photonpano_colmap.posing.path import Path, between

Image = NDArray[np.float32]

_CHUNK_PX = 1.0  # frames that move less than this are summed before they are warped
_STEP_PX = 8  # spacing of the grid on which depth is interpolated
_MARGIN = 0.05  # points up to this far outside of the frame are used, in its longer side
# A point is an outlier if its inverse depth differs from the median of its 7 neighbours by half of it.
_NEIGHBOURS = 7
_APART = 0.5
_LEAST = 4  # fewest points of a depth map


@dataclass(frozen=True, slots=True, eq=False)
class PosedExposure:
    """A virtual exposure, with its place in the world."""

    exposure: VirtualExposure  # flux and weight, seen from the reference instant of its group
    pose: FloatArray  # (3, 4) of that instant
    inverse_depth: Image  # (H, W) of its pixels


def merge_through_depth(source: Source, group: Group, path: Path, inverse_depth: Image, camera: Camera) -> PosedExposure:
    """Merge the frames of a group as its reference instant sees them (paper, section 6: aggregation that is consistent in 3D).

    Each chunk of frames is interpolated once, where its frames see the points of the reference view. Occlusions are ignored.
    """
    pose = path.at([group.reference])[0]
    counts, weight = np.zeros((2, *source.info.frame_shape), np.float32)
    lens = lens_of(camera, source.info.frame_shape)
    plane = _Plane(path, pose, float(np.median(inverse_depth)), camera)
    for chunk in chunks_of(group.span, plane, source.info.frame_shape, _CHUNK_PX):
        turn, shift = between(pose, path.at([chunk.span.centre])[0], camera.matrix)
        valid = capture_of(source).masked_in(chunk.span).valid.astype(np.float32)
        frames = lit_counts(source, chunk.span) * valid
        _add(frames, valid * np.float32(len(chunk.span)), inverse_depth, lens, turn, shift, counts, weight)
    flux, seen = PhotonSum(counts, weight).estimate(source.response)
    return PosedExposure(VirtualExposure(flux, seen, group, 1.0, source.response), pose, inverse_depth)


class _Plane:
    """The motion of a plane before a view at the median depth, by which frames are divided into chunks."""

    def __init__(self, path: Path, pose: FloatArray, inverse_depth: float, camera: Camera) -> None:
        self._path, self._pose, self._inverse_depth, self._matrix = path, pose, inverse_depth, camera.matrix

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the maps from pixels of frames to those of the view: (N, 3, 3)."""
        maps, shifts = between(self._pose, self._path.at(frame_indices), self._matrix)
        maps[:, :, 2] += self._inverse_depth * shifts
        return scaled_ahead(inverse(maps))


def lit_counts(source: Source, span: FrameSpan) -> Image:
    """Return the sum of the frames of a span, of the flux alone: (H, W)."""
    return capture_of(source).corrected_counts(span).astype(np.float32)


@compiled
def _add(
    frames: Image,
    frame_weight: Image,
    inverse_depth: Image,
    lens: Lens,
    turn: FloatArray,
    shift: FloatArray,
    counts: Image,
    weight: Image,
) -> None:
    """Add (H, W) counts and weights of frames to those of a view, interpolated bilinearly; see `path.between`."""
    height, width = frames.shape
    for y in range(height):
        row, counts_of, weight_of = inverse_depth[y], counts[y], weight[y]
        for x in range(width):
            q, px, py = row[x], lens.ideal[y, x, 0], lens.ideal[y, x, 1]
            depth = turn[2, 0] * px + turn[2, 1] * py + turn[2, 2] + q * shift[2]
            if not depth > 0:
                continue
            u = (turn[0, 0] * px + turn[0, 1] * py + turn[0, 2] + q * shift[0]) / depth
            v = (turn[1, 0] * px + turn[1, 1] * py + turn[1, 2] + q * shift[1]) / depth
            u, v = imaged(lens, u, v)
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            i, j = min(int(u), width - 2), min(int(v), height - 2)
            a, b = np.float32(u - i), np.float32(v - j)
            upper, lower = frames[j], frames[j + 1]
            upper_weight, lower_weight = frame_weight[j], frame_weight[j + 1]
            one = np.float32(1)
            counts_of[x] += (one - b) * ((one - a) * upper[i] + a * upper[i + 1]) + b * (
                (one - a) * lower[i] + a * lower[i + 1]
            )
            weight_of[x] += (one - b) * ((one - a) * upper_weight[i] + a * upper_weight[i + 1]) + b * (
                (one - a) * lower_weight[i] + a * lower_weight[i + 1]
            )


def inverse_depth_of(pose: FloatArray, points: FloatArray, camera: Camera, shape: tuple[int, int]) -> Image | None:
    """Return the inverse depth of the pixels of a view, (H, W), from points of the world; None if it sees fewer than 4.

    It is linear between points, as that of a plane is. At the edges of things it is wrong by the width of a triangle; within a
    group, the camera moves so little that this hardly matters.
    """
    height, width = shape
    seen = points @ pose[:, :3].T + pose[:, 3]
    seen = seen[seen[:, 2] > 0]
    pixels = seen @ camera.matrix.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    margin = _MARGIN * max(shape)
    ideal = lens_of(camera, shape).ideal
    low, high = np.nanmin(ideal, axis=(0, 1)) - margin, np.nanmax(ideal, axis=(0, 1)) + 1 + margin
    inside = ((pixels > low) & (pixels < high)).all(axis=1)
    pixels, inverse_depth = pixels[inside], 1 / seen[inside, 2]
    if len(pixels) >= _NEIGHBOURS:
        _, nearest = cKDTree(pixels).query(pixels, k=_NEIGHBOURS)
        median = np.median(inverse_depth[nearest], axis=1)
        kept = np.abs(inverse_depth - median) < _APART * median
        pixels, inverse_depth = pixels[kept], inverse_depth[kept]
    if len(pixels) < _LEAST or np.linalg.matrix_rank(pixels - pixels.mean(axis=0), tol=1.0) < 2:
        return None
    rows, columns = -(-height // _STEP_PX), -(-width // _STEP_PX)
    middle = (_STEP_PX - 1) / 2
    x, y = np.meshgrid(np.arange(columns) * _STEP_PX + middle, np.arange(rows) * _STEP_PX + middle)
    places = camera.ideal(np.stack([x, y], axis=-1))
    places = np.where(np.isfinite(places), places, camera.centre_px)
    grid = LinearNDInterpolator(pixels, inverse_depth)(places)
    grid = np.where(np.isfinite(grid), grid, NearestNDInterpolator(pixels, inverse_depth)(places)).astype(np.float32)
    fine = cv2.resize(grid, (columns * _STEP_PX, rows * _STEP_PX), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[:height, :width])
