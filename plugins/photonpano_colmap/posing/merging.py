"""Merge frames along the path of the camera, through the depth of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano import FloatArray, FrameSpan, Group, Source, VirtualExposure, capture_of
from photonpano.compiling import compiled
from photonpano.geometry import inverse, scaled_ahead
from photonpano.merging import PhotonSum, chunks_of
from photonpano_colmap.posing.path import Path, between

_CHUNK_PX = 1.0  # frames that move less than this are summed before they are warped


@dataclass(frozen=True, slots=True, eq=False)
class PosedExposure:
    """A virtual exposure, with its place in the world."""

    exposure: VirtualExposure  # flux and weight, seen from the reference instant of its group
    pose: FloatArray  # (3, 4) of that instant
    inverse_depth: NDArray[np.float32]  # (H, W) of its pixels


def merge_through_depth(
    source: Source, group: Group, path: Path, inverse_depth: NDArray[np.float32], camera_matrix: FloatArray
) -> PosedExposure:
    """Merge the frames of a group as its reference instant sees them (paper, section 6: aggregation that is consistent in 3D).

    Each chunk of frames is interpolated once, where its frames see the points of the reference view. Occlusions are ignored.
    """
    pose = path.at([group.reference])[0]
    counts, weight = np.zeros((2, *source.info.frame_shape), np.float32)
    valid = source.valid.astype(np.float32)
    plane = _Plane(path, pose, float(np.median(inverse_depth)), camera_matrix)
    for chunk in chunks_of(group.span, plane, source.info.frame_shape, _CHUNK_PX):
        turn, shift = between(pose, path.at([chunk.span.centre])[0], camera_matrix)
        frames = lit_counts(source, chunk.span) * valid
        _add(frames, valid * np.float32(len(chunk.span)), inverse_depth, turn, shift, counts, weight)
    flux, seen = PhotonSum(counts, weight).estimate(source.response)
    return PosedExposure(VirtualExposure(flux, seen, group, 1.0, source.response), pose, inverse_depth)


class _Plane:
    """The motion of a plane before a view at the median depth, by which frames are divided into chunks."""

    def __init__(self, path: Path, pose: FloatArray, inverse_depth: float, camera_matrix: FloatArray) -> None:
        self._path, self._pose, self._inverse_depth, self._matrix = path, pose, inverse_depth, camera_matrix

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the maps from pixels of frames to those of the view: (N, 3, 3)."""
        maps, shifts = between(self._pose, self._path.at(frame_indices), self._matrix)
        maps[:, :, 2] += self._inverse_depth * shifts
        return scaled_ahead(inverse(maps))


def lit_counts(source: Source, span: FrameSpan) -> NDArray[np.float32]:
    """Return the sum of the frames of a span, of the flux alone: (H, W)."""
    return capture_of(source).corrected_counts(span).astype(np.float32)


@compiled
def _add(
    frames: NDArray[np.float32],
    frame_weight: NDArray[np.float32],
    inverse_depth: NDArray[np.float32],
    turn: FloatArray,
    shift: FloatArray,
    counts: NDArray[np.float32],
    weight: NDArray[np.float32],
) -> None:
    """Add (H, W) counts and weights of frames to those of a view, interpolated bilinearly; see `path.between`."""
    height, width = frames.shape
    for y in range(height):
        row, counts_of, weight_of = inverse_depth[y], counts[y], weight[y]
        for x in range(width):
            q = row[x]
            depth = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + q * shift[2]
            if not depth > 0:
                continue
            u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + q * shift[0]) / depth
            v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + q * shift[1]) / depth
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
