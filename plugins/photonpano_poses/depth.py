"""The depth of every pixel of key exposures, with its error, from exposures whose poses are known: a plane sweep.

The depth of a key exposure is found from the others alone, so that its own photons judge it. For each pixel and inverse depth,
the deviance of "all exposures see one flux there" against "each sees its own" is the cost: a chi-square, on the scale on which
photon noise is uniform. Semi-global matching (Hirschmueller 2008) adds what neighbours say. Its sums, less the costs that they
count more than once, are what each inverse depth costs if all others are chosen best (Drory et al. 2014): minus twice the
logarithm of a likelihood, whose curvature and width are the error.

Convention:
    Inverse depths are along the optical axis, in units of the world. Maps have the pixels of a frame, with its distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray, Group, Progress, Reason, Source, VirtualExposure
from photonpano.compiling import compiled
from photonpano.geometry import Camera
from photonpano.locating import view_of
from photonpano_poses.contract import DepthMap, PosedView, PoseEstimate
from photonpano_poses.views import Lens, between, imaged, lens_of, sampled, seen_at

Image = NDArray[np.float32]

_KEYS = 32  # key exposures, at most
_OTHERS = 24  # exposures that a key is compared with, at most
_OVERLAP = 0.5  # they see the middle of the key within this share of a frame
_BLUR_PX = 1.0  # standard deviation of the blur against photon noise
_STEP_PX = 0.5  # parallax from one inverse depth to the next, root mean square
_FEWEST, _MOST = 48, 128  # inverse depths
_BEYOND = 0.005  # share of the points that may be nearer, or farther, than the inverse depths reach
_WIDER = 0.4  # share by which the inverse depths reach beyond the points: what has no texture has none
_LEAST_POINTS = 8
# Deviances of neighbours whose inverse depths differ by one step, and by more; the latter falls across edges of the flux.
_SLOPED, _BROKEN = 2.0, 12.0
_EDGE_PX = 3.0  # standard deviation of the place of an edge of depth
_LEAST_SEEN = 3  # fewest exposures that show a pixel
_AGREE = 3.0  # standard errors within which two keys agree


def with_depth(source: Source, estimate: PoseEstimate, threads: int, progress: Progress) -> PoseEstimate:
    """Find the depth of the exposures of an estimate; of many, of 32 evenly chosen ones.

    One without depth has too few points, too few others see the same, or none from another place.
    """
    camera, shape = Camera(estimate.camera_matrix, estimate.distortion), source.info.frame_shape
    seen = _Seen.of(source, estimate.views)
    number = len(estimate.views)
    keys = np.unique(np.linspace(0, number - 1, min(_KEYS, number)).round().astype(int)).tolist() if number else []
    maps: list[DepthMap] = []
    with (
        progress.stage("depth of key exposures", len(keys), "key") as advance,
        ThreadPoolExecutor(threads) as pool,
    ):

        def swept(key: int) -> DepthMap | None:
            found = _depth_of(key, seen, estimate, camera, shape)
            advance(1)
            return found

        maps = [each for each in pool.map(swept, keys) if each is not None]
        checked = list(pool.map(lambda each: _checked(each, maps, estimate.views, camera), maps))
    if not checked:
        advice = "move farther across the view, so that near things pass far ones"
        nowhere = Reason("the depth is not known", 1.0, 0.5, "share of the exposures without a depth map", advice)
        return replace(estimate, doubts=(*estimate.doubts, nowhere))
    return replace(estimate, depth=tuple(checked))


class _Seen(NamedTuple):
    """Exposures as images of uniform noise."""

    flux: Image  # (V, H, W), NaN where unknown
    images: Image  # (V, H, W), blurred; NaN where unknown
    weights: Image  # (V,) inverse variance of the noise of a pixel before the blur
    noise_left: float  # share of the variance that the blur leaves

    @classmethod
    def of(cls, source: Source, views: Sequence[PosedView]) -> _Seen:
        fluxes, images, weights, noise_left = [], [], [], 1.0
        for view in views:
            flux = view.flux()
            weight = np.where(np.isfinite(flux), np.float32(len(view.span)), np.float32(0))
            exposure = VirtualExposure(flux, weight, Group(view.span, view.instant), 1.0, source.response)
            image = view_of(exposure, _BLUR_PX)
            fluxes.append(flux)
            images.append(np.where(image.seen, image.image, np.float32(np.nan)))
            weights.append(float(np.median(image.weight[image.seen])) if image.seen.any() else 0.0)
            noise_left = image.noise_left
        return cls(np.array(fluxes, np.float32), np.array(images, np.float32), np.array(weights, np.float32), noise_left)


def _depth_of(key: int, seen: _Seen, estimate: PoseEstimate, camera: Camera, shape: tuple[int, int]) -> DepthMap | None:
    """Sweep planes before a key exposure."""
    views, pose = estimate.views, estimate.views[key].camera_from_world
    points = estimate.points.positions[views[key].points]
    ahead = points @ pose[2, :3] + pose[2, 3]
    ahead = ahead[ahead > 0]
    if len(ahead) < _LEAST_POINTS:
        return None
    low, high = np.quantile(1 / ahead, [_BEYOND, 1 - _BEYOND])
    low, high = (1 - _WIDER) * low, (1 + _WIDER) * high
    middle = float(np.median(1 / ahead))
    others = _others(key, views, camera, shape, middle)
    if len(others) < _LEAST_SEEN:
        return None
    turns, shifts = between(pose, np.array([views[each].camera_from_world for each in others]), camera.matrix)
    # Parallax of the middle of the frame per unit of inverse depth.
    parallax = float(np.sqrt(np.mean(np.sum((shifts[:, :2] - np.outer(shifts[:, 2], camera.centre_px)) ** 2, axis=1))))
    if not (high - low) * parallax > _STEP_PX:
        return None
    number = int(np.clip(np.ceil((high - low) * parallax / _STEP_PX), _FEWEST, _MOST))
    steps = np.linspace(low, high, number)
    lens = lens_of(camera, shape)
    images, weights = seen.images[others], seen.weights[others]
    before = np.array(others) < key
    cost = np.empty((*shape, number), np.float32)
    _sweep(images, weights, before, turns, shifts, steps, lens, seen.noise_left, cost)
    guide = np.nan_to_num(seen.images[key], nan=float(np.nanmedian(seen.images[key])))
    edge = float(seen.weights[key]) / (2 * seen.noise_left)
    total = _smoothed(cost, guide, edge)
    inverse_depth, std = np.empty(shape, np.float32), np.empty(shape, np.float32)
    _best(total, cost, steps, inverse_depth, std)
    # Where both ends of a baseline are not known, neither is the scale of what is seen from there.
    scale = np.float32(np.sqrt(2) * estimate.std_position[int(views[key].instant)] * camera.focal_px / parallax)
    std = np.sqrt(std**2 + _spread(inverse_depth) ** 2 + (scale * inverse_depth) ** 2)
    predicted, nearer, farther = np.empty((3, *shape), np.float32)
    off = _AGREE * std
    for depth, flux in ((inverse_depth, predicted), (inverse_depth + off, nearer), (inverse_depth - off, farther)):
        _predict(seen.flux[others], weights, turns, shifts, depth, lens, flux)
    return DepthMap(key, inverse_depth, std, predicted, nearer, farther)


def _spread(inverse_depth: Image) -> Image:
    """Return the standard deviation of the inverse depth around each pixel, (H, W), which may lie on either side of an edge."""
    known = np.isfinite(inverse_depth)
    filled = np.where(known, inverse_depth, np.float32(0))
    weight, mean, square = (cv2.GaussianBlur(each, (0, 0), _EDGE_PX) for each in (known.astype(np.float32), filled, filled**2))
    weight = np.maximum(weight, np.float32(1e-6))
    return np.asarray(np.sqrt(np.maximum(square / weight - (mean / weight) ** 2, 0)), np.float32)


def _others(key: int, views: Sequence[PosedView], camera: Camera, shape: tuple[int, int], inverse_depth: float) -> list[int]:
    """Return the exposures that see the middle of a key, evenly chosen."""
    height, width = shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    turns, shifts = between(views[key].camera_from_world, np.array([view.camera_from_world for view in views]), camera.matrix)
    at = turns @ np.append(middle, 1.0) + inverse_depth * shifts
    away = np.abs(at[:, :2] / at[:, 2:] - middle)
    near = np.flatnonzero((at[:, 2] > 0) & (away < _OVERLAP * np.array([width, height])).all(axis=1))
    near = near[near != key]
    places = np.linspace(0, len(near) - 1, min(_OTHERS, len(near))).round().astype(int)
    return [int(each) for each in near[places]]


@compiled
def _sweep(  # noqa: PLR0913, PLR0917
    images: Image,
    weights: Image,
    before: BoolArray,
    turns: FloatArray,
    shifts: FloatArray,
    steps: FloatArray,
    lens: Lens,
    noise_left: float,
    cost: Image,
) -> None:
    """Write the deviance of one flux against many, (H, W, D), for each inverse depth of (D,) steps.

    What is nearer hides a place from the exposures on one side of the key, before or after it: the side that agrees better
    counts, as both would.
    """
    height, width, number = cost.shape
    sums = np.empty((number, 8))  # of either side: number, and sums of w, w s and w s^2
    for y in range(height):
        for x in range(width):
            sums[:] = 0
            px, py = lens.ideal[y, x, 0], lens.ideal[y, x, 1]
            for v in range(len(images)):
                turn, shift, weight, image = turns[v], shifts[v], weights[v], images[v]
                side = 0 if before[v] else 4
                a = turn[0, 0] * px + turn[0, 1] * py + turn[0, 2]
                b = turn[1, 0] * px + turn[1, 1] * py + turn[1, 2]
                c = turn[2, 0] * px + turn[2, 1] * py + turn[2, 2]
                along_x, along_y, along_z = shift[0], shift[1], shift[2]
                for d in range(number):
                    q = steps[d]
                    depth = c + q * along_z
                    if not depth > 0:
                        continue
                    u, w = (a + q * along_x) / depth, (b + q * along_y) / depth
                    if lens.distorts:
                        u, w = imaged(lens, u, w)
                    if not (0 <= u < width - 1 and 0 <= w < height - 1):
                        continue
                    # As `sampled` does, whose call takes as long again.
                    i, j = int(u), int(w)
                    e, f = np.float32(u - i), np.float32(w - j)
                    upper = image[j, i] + e * (image[j, i + 1] - image[j, i])
                    lower = image[j + 1, i] + e * (image[j + 1, i + 1] - image[j + 1, i])
                    value = upper + f * (lower - upper)
                    if value == value:
                        sums[d, side] += 1
                        sums[d, side + 1] += weight
                        sums[d, side + 2] += weight * value
                        sums[d, side + 3] += weight * value * value
            for d in range(number):
                seen = sums[d, 0] + sums[d, 4]
                if seen < _LEAST_SEEN:
                    cost[y, x, d] = np.nan
                    continue
                sum_w, sum_s, sum_q = sums[d, 1] + sums[d, 5], sums[d, 2] + sums[d, 6], sums[d, 3] + sums[d, 7]
                best = (sum_q - sum_s * sum_s / sum_w) / (seen - 1)
                for side in (0, 4):
                    if sums[d, side] >= _LEAST_SEEN:
                        alone = sums[d, side + 3] - sums[d, side + 2] * sums[d, side + 2] / sums[d, side + 1]
                        # The smaller of two is smaller by chance.
                        freedom = sums[d, side] - 1
                        best = min(best, alone / freedom + noise_left * np.sqrt(2.0 / freedom))
                cost[y, x, d] = best * (len(images) - 1)


@compiled
def _smooth_along(  # noqa: PLR0917
    cost: Image, guide: Image, edge: float, dx: int, dy: int, total: Image
) -> None:
    """Add the costs of the best ways along one direction that end at each pixel and inverse depth: (H, W, D)."""
    height, width, number = cost.shape
    previous, current = np.zeros((width, number), np.float32), np.zeros((width, number), np.float32)
    sloped = np.float32(_SLOPED)
    for j in range(height):
        y = j if dy >= 0 else height - 1 - j
        for i in range(width):
            x = i if dx >= 0 else width - 1 - i
            from_x, from_y = x - dx, y - dy
            row = current[x]
            if not (0 <= from_x < width and 0 <= from_y < height):
                for d in range(number):
                    row[d] = cost[y, x, d]
                    total[y, x, d] += row[d]
                continue
            way = current[from_x] if dy == 0 else previous[from_x]
            least = way[0]
            for d in range(1, number):
                least = min(least, way[d])
            step = guide[y, x] - guide[from_y, from_x]
            broken = np.float32(max(_BROKEN / (1 + edge * step * step / 4), 2 * _SLOPED))
            for d in range(number):
                best = min(way[d], least + broken)
                if d > 0:
                    best = min(best, way[d - 1] + sloped)
                if d < number - 1:
                    best = min(best, way[d + 1] + sloped)
                row[d] = cost[y, x, d] + best - least
                total[y, x, d] += row[d]
        if dy != 0:
            previous, current = current, previous


def _smoothed(cost: Image, guide: Image, edge: float) -> Image:
    """Return the min-marginals of semi-global matching along eight directions, (H, W, D)."""
    cost[~np.isfinite(cost).all(axis=2)] = 0
    total = np.zeros_like(cost)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        _smooth_along(cost, guide, edge, dx, dy, total)
    total -= np.float32(7) * cost
    return total


@compiled
def _best(total: Image, cost: Image, steps: FloatArray, inverse_depth: Image, std: Image) -> None:
    """Write the likeliest inverse depth, (H, W), and its error; NaN at the first and the last step."""
    height, width, number = total.shape
    step = steps[1] - steps[0]
    for y in range(height):
        for x in range(width):
            of = total[y, x]
            best = 0
            for d in range(1, number):
                if of[d] < of[best]:
                    best = d
            inverse_depth[y, x] = std[y, x] = np.nan
            if best in (0, number - 1) or cost[y, x, best] == 0:
                continue
            curve = of[best - 1] - 2 * of[best] + of[best + 1]
            if not curve > 0:
                continue
            at = 0.5 * (of[best - 1] - of[best + 1]) / curve
            probability, mean, square = 0.0, 0.0, 0.0
            for d in range(number):
                p = np.exp(-0.5 * (of[d] - of[best]))
                probability += p
                mean += p * (d - best)
                square += p * (d - best) ** 2
            mean /= probability
            inverse_depth[y, x] = steps[best] + at * step
            std[y, x] = step * np.sqrt(max(2 / curve, square / probability - mean * mean))


@compiled
def _predict(  # noqa: PLR0917
    images: Image, weights: Image, turns: FloatArray, shifts: FloatArray, inverse_depth: Image, lens: Lens, predicted: Image
) -> None:
    """Write the mean flux that other exposures see at the depth of each pixel, (H, W)."""
    height, width = inverse_depth.shape
    predicted[:] = 0
    total, ideal = np.zeros_like(predicted), lens.ideal
    for v in range(len(images)):
        image, turn, shift, weight = images[v], turns[v], shifts[v], weights[v]
        for y in range(height):
            for x in range(width):
                px, py, q = ideal[y, x, 0], ideal[y, x, 1], inverse_depth[y, x]
                depth = turn[2, 0] * px + turn[2, 1] * py + turn[2, 2] + q * shift[2]
                if not depth > 0:
                    continue
                u = (turn[0, 0] * px + turn[0, 1] * py + turn[0, 2] + q * shift[0]) / depth
                w = (turn[1, 0] * px + turn[1, 1] * py + turn[1, 2] + q * shift[1]) / depth
                if lens.distorts:
                    u, w = imaged(lens, u, w)
                value = sampled(image, u, w)
                if value == value:
                    predicted[y, x] += weight * value
                    total[y, x] += weight
    predicted /= total  # NaN where none sees it


def _checked(depth: DepthMap, maps: Sequence[DepthMap], views: Sequence[PosedView], camera: Camera) -> DepthMap:
    """Drop pixels that no other key confirms."""
    others = [other for other in maps if other is not depth]
    kept = _confirmed(depth, others, views, camera) if others else np.isfinite(depth.inverse_depth)
    return replace(
        depth,
        inverse_depth=np.where(kept, depth.inverse_depth, np.float32(np.nan)),
        std=np.where(kept, depth.std, np.float32(np.nan)),
    )


def _confirmed(depth: DepthMap, others: Sequence[DepthMap], views: Sequence[PosedView], camera: Camera) -> BoolArray:
    """Return the pixels whose depth agrees with that of other keys: (H, W)."""
    pose = views[depth.view].camera_from_world
    lens = lens_of(camera, depth.inverse_depth.shape)
    confirmed = np.zeros(depth.inverse_depth.shape, np.bool_)
    for other in others:
        turn, shift = between(pose, views[other.view].camera_from_world, camera.matrix)
        _confirm(depth.inverse_depth, depth.std, other.inverse_depth, other.std, lens, turn, shift, confirmed)
    return confirmed


@compiled
def _confirm(  # noqa: PLR0917
    inverse_depth: Image,
    std: Image,
    other: Image,
    other_std: Image,
    lens: Lens,
    turn: FloatArray,
    shift: FloatArray,
    confirmed: BoolArray,
) -> None:
    """Mark the pixels whose depth agrees with that of another key at their place, within the errors of both."""
    height, width = inverse_depth.shape
    for y in range(height):
        for x in range(width):
            q = inverse_depth[y, x]
            if confirmed[y, x] or not q > 0:
                continue
            u, v, depth = seen_at(lens, turn, shift, lens.ideal[y, x, 0], lens.ideal[y, x, 1], q)
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            i, j = int(u + 0.5), int(v + 0.5)
            # The third homogeneous coordinate is the depth in the other camera, relative to that in this one.
            error = np.sqrt(std[y, x] ** 2 / depth**4 + other_std[j, i] ** 2)
            confirmed[y, x] = abs(other[j, i] - q / depth) < _AGREE * error


def see_depth(estimate: PoseEstimate, instant: float, pose: FloatArray, inverse_depth: Image) -> None:
    """Correct the inverse depth of a view, (H, W), by the depth map of an estimate that is nearest to its instant.

    Pixels whose depth that map does not know stay as they are.
    """
    if not estimate.depth:
        return
    nearest = min(estimate.depth, key=lambda each: abs(estimate.views[each.view].instant - instant))
    camera = Camera(estimate.camera_matrix, estimate.distortion)
    turn, shift = between(pose, estimate.views[nearest.view].camera_from_world, camera.matrix)
    _see_depth(nearest.inverse_depth, lens_of(camera, inverse_depth.shape), turn, shift, inverse_depth)


_STEPS = 3  # of the search for the pixel of a depth map that shows what a pixel of another view does


@compiled
def _see_depth(known: Image, lens: Lens, turn: FloatArray, shift: FloatArray, inverse_depth: Image) -> None:
    """Correct (H, W) inverse depths by those of another view at the pixels that they lead to."""
    height, width = inverse_depth.shape
    for y in range(height):
        for x in range(width):
            for _ in range(_STEPS):
                u, v, depth = seen_at(lens, turn, shift, lens.ideal[y, x, 0], lens.ideal[y, x, 1], inverse_depth[y, x])
                if not (-0.5 < u < width - 0.5 and -0.5 < v < height - 0.5):
                    break
                q = known[int(v + 0.5), int(u + 0.5)]
                if q == q:
                    inverse_depth[y, x] = q * depth


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Surface elements of the scene: one for each pixel of a key that no earlier key has."""

    positions: FloatArray  # (N, 3) in the world
    normals: FloatArray  # (N, 3) of length 1, towards the camera
    std: FloatArray  # (N,) expected error along the ray, in units of the world
    flux: FloatArray  # (N,) photons per pixel per frame
    sizes: FloatArray  # (N,) side of the pixel at this depth, in units of the world


# A plane is fitted to the neighbours within this many px that a surface can hold, up to this steep to the view.
_NEIGHBOURS, _STEEPEST = 8, 2.0


def fused(estimate: PoseEstimate) -> Surface:
    """Return the surface that the depth maps of an estimate show."""
    camera = Camera(estimate.camera_matrix, estimate.distortion)
    parts = [_part(depth, estimate.depth[:place], estimate.views, camera) for place, depth in enumerate(estimate.depth)]
    return Surface(*(np.concatenate([part[k] for part in parts]) for k in range(5)))


def _part(depth: DepthMap, earlier: Sequence[DepthMap], views: Sequence[PosedView], camera: Camera) -> tuple[FloatArray, ...]:
    pose, shape = views[depth.view].camera_from_world, depth.inverse_depth.shape
    known = np.isfinite(depth.inverse_depth) & np.isfinite(depth.flux)
    new = known & ~_confirmed(depth, earlier, views, camera)
    pixels = np.concatenate([lens_of(camera, shape).ideal, np.ones((*shape, 1))], axis=2)[new]
    q, std = depth.inverse_depth[new].astype(float), depth.std[new].astype(float)
    seen = pixels @ np.linalg.inv(camera.matrix).T / q[:, None]
    slopes = np.zeros((*shape, 2))
    _slopes(depth.inverse_depth, depth.std, camera.focal_px, slopes)
    slope_x, slope_y = slopes[new].T
    # The points of a plane have an inverse depth that is linear in the pixel: (a, b, c) . (x, y, 1) = 1 / z, so that
    # (a, b, c) K X = 1.
    plane = np.stack([slope_x, slope_y, q - slope_x * pixels[:, 0] - slope_y * pixels[:, 1]], axis=1) @ camera.matrix
    normals = -plane / np.linalg.norm(plane, axis=1, keepdims=True)
    length = np.linalg.norm(seen, axis=1)
    world = (seen - pose[:, 3]) @ pose[:, :3]
    return world, normals @ pose[:, :3], length * std / q, depth.flux[new].astype(float), seen[:, 2] / camera.focal_px


@compiled
def _slopes(inverse_depth: Image, std: Image, focal_px: float, slopes: FloatArray) -> None:
    """Write the slopes of the inverse depth along x and y, (H, W, 2), by weighted least squares."""
    height, width = inverse_depth.shape
    for y in range(height):
        for x in range(width):
            q = inverse_depth[y, x]
            w, wx, wy, wq, xx, xy, yy, xq, yq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(max(-_NEIGHBOURS, -y), min(_NEIGHBOURS, height - 1 - y) + 1):
                for i in range(max(-_NEIGHBOURS, -x), min(_NEIGHBOURS, width - 1 - x) + 1):
                    off = inverse_depth[y + j, x + i] - q
                    if abs(off) <= _STEEPEST * q / focal_px * np.sqrt(i * i + j * j):
                        weight = 1 / std[y + j, x + i] ** 2
                        w += weight
                        wx += weight * i
                        wy += weight * j
                        wq += weight * off
                        xx += weight * i * i
                        xy += weight * i * j
                        yy += weight * j * j
                        xq += weight * i * off
                        yq += weight * j * off
            if not w > 0:
                continue
            xx, xy, yy = xx - wx * wx / w, xy - wx * wy / w, yy - wy * wy / w
            xq, yq = xq - wx * wq / w, yq - wy * wq / w
            determinant = xx * yy - xy * xy
            if determinant > 0:
                slopes[y, x, 0] = (yy * xq - xy * yq) / determinant
                slopes[y, x, 1] = (xx * yq - xy * xq) / determinant
