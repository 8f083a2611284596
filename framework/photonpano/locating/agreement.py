"""The rotation on which most matches of a camera that only turns agree, and how many may agree on one by chance."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from photonpano.geometry import Camera, nearest_rotations, transform_points
from photonpano.values import BoolArray, FloatArray, Homography

# Pairs of matches that are tried at most; of more, as many are drawn, 200 of them right if a fifth of the matches are.
_MOST_PAIRS = 5000
_MOST_SCORED = 500_000  # rotations are scored until they have mapped this many points
_BASELINE = 10.0  # two matches determine a rotation if they are further apart than this, in units of the threshold
_ROUNDS = 3  # how often the best rotation is fitted to the matches that agree with it
# Expected number of rotations, of all that two matches determine, on which as many matches agree by chance.
_FALSE_ALARMS = 1e-4
_FAR_PX = 1e6  # points that are mapped further away are taken to lie there


def distinct(moving: FloatArray, fixed: FloatArray, threshold_px: float) -> BoolArray:
    """Return which of N matches are not the same as an earlier one, within a threshold in both images: (N,).

    A structure that is detected at several sizes or orientations matches several times, and then agrees with itself.
    """
    kept = np.ones(len(moving), dtype=bool)
    near = cKDTree(np.concatenate([moving, fixed], axis=1)).query_pairs(threshold_px, output_type="ndarray")
    kept[near.max(axis=1, initial=0)] = False
    kept[:1] = True
    return kept


def rotation_of_most(moving: FloatArray, fixed: FloatArray, camera: Camera, threshold_px: float) -> Homography | None:
    """Return the homography K R K^-1 of the rotation R on which most matches agree; None if no two of them determine one.

    Every two matches determine a rotation. Those of all pairs, or of a sample, are scored by the squared distances that they
    leave, each at most that of the threshold; the best is fitted to the matches that agree with it. Points are (N, 2) in px of
    images without distortion.
    """
    rays, partners = camera.directions(moving), camera.directions(fixed)
    first, second = _pairs(len(moving))
    here, there = (np.linalg.norm(each[first] - each[second], axis=1) * camera.focal_px for each in (rays, partners))
    chosen = (np.abs(here - there) < 2 * threshold_px) & (np.minimum(here, there) > _BASELINE * threshold_px)
    first, second = first[chosen], second[chosen]
    if not len(first):
        return None
    first, second = (each[: max(1, _MOST_SCORED // len(moving))] for each in (first, second))
    rotations = _frames(partners[first], partners[second]) @ np.swapaxes(_frames(rays[first], rays[second]), -1, -2)

    def squares(rotations: FloatArray) -> FloatArray:
        left = np.square(transform_points(camera.homographies(rotations), moving) - fixed).sum(axis=-1)
        return np.asarray(np.fmin(left, threshold_px**2))

    costs = squares(rotations).sum(axis=1)
    best, cost = rotations[costs.argmin()], costs.min()
    for _ in range(_ROUNDS):
        agrees = squares(best) < threshold_px**2
        refined = nearest_rotations(partners[agrees].T @ rays[agrees])
        if (left := squares(refined).sum()) >= cost:
            break
        best, cost = refined, left
    return camera.homographies(best)


def agreeing_by_chance(
    moving: FloatArray, fixed: FloatArray, homography: Homography, threshold_px: float, search_px: float
) -> int:
    """Return the largest number of matches, (N, 2) points and partners, that may agree on a rotation by chance.

    This is an a-contrario test (Moisan and Stival 2004). Two of N matches determine a rotation; each other one agrees with it
    by chance with a probability p. More than the number returned do so for `_FALSE_ALARMS` of all N (N - 1) / 2 rotations on
    average. Where partners are searched within a radius, p is the share of its area. If that is infinite, for the whole image,
    p is the share of matches that would agree if they exchanged their partners; it is large where keypoints cluster.
    """
    count = len(moving)
    if np.isfinite(search_px):
        share = min(1.0, (threshold_px / search_px) ** 2)
    else:
        mapped = np.clip(np.nan_to_num(transform_points(homography, moving)), -_FAR_PX, _FAR_PX)
        near = cKDTree(mapped).sparse_distance_matrix(cKDTree(fixed), threshold_px, output_type="ndarray")
        exchanged = int(np.count_nonzero(near["i"] != near["j"]))
        share = max(exchanged, 1) / (count * (count - 1))
    others = np.arange(count - 1)
    tail = bdtrc(others, count - 2, share) * count * (count - 1) / 2
    return int(others[tail < _FALSE_ALARMS][0]) + 2


def _pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of different indices below a number, in random order: all, or `_MOST_PAIRS`."""
    rng = np.random.default_rng(0)
    if count * (count - 1) // 2 <= _MOST_PAIRS:
        first, second = np.triu_indices(count, 1)
        order = rng.permutation(len(first))
        return first[order], second[order]
    first = rng.integers(count, size=_MOST_PAIRS)
    return first, (first + rng.integers(1, count, size=_MOST_PAIRS)) % count


def _frames(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return frames of pairs of directions, (N, 3) each: the bisector, the normal, and what is normal to both, as columns.

    The rotation between the frames of two pairs of directions is that of least squares (Kabsch 1976).
    """
    bisector, normal = first + second, np.cross(first, second)
    bisector, normal = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (bisector, normal))
    return np.stack([bisector, normal, np.cross(bisector, normal)], axis=-1)
