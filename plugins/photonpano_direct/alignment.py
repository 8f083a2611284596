"""Align one layer of an exposure, the template, to that of another, and estimate how well.

Inverse-compositional Gauss-Newton steps on homographies (Baker and Matthews 2004), with Levenberg-Marquardt damping. One more
step for each patch of the aligned template says where the patch lies, beyond the homography.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from threading import local

import cv2
import numpy as np

from photonpano import FloatArray, Homography, NotLocated, Patches
from photonpano.compiling import compiled
from photonpano.geometry import (
    PATCHES,
    corners,
    generators,
    patch_centres,
    slopes,
    transform_points,
    unit_coordinates,
    violation,
    why_implausible,
)
from photonpano.locating import NO_TEXTURE, information_on_turn, noise_of
from photonpano_direct.normal_equations import (
    MOMENTS_X,
    MOMENTS_Y,
    PRIOR,
    Buffers,
    Coordinates,
    Layer,
    applied,
    chance_level,
    curvatures,
    dot,
    expected_px,
    information_of,
    inverse_homography,
    local_noise,
    product,
    residuals_and_moments,
    scaled_to_one,
    solve,
    transposed,
)

# Exit status: no texture is flat, an impossible homography diverges.
_CONVERGED, _FLAT, _MAX_STEPS, _DIVERGED = 0, 1, 2, 3
_MIN_CURVATURE = 5.0  # floor on the common curvature, relative to that of noise by chance; it bounds the steps
# Levenberg-Marquardt damping after a step that raised the cost, as a fraction of the Hessian of the template; multiplied by 4
# on each further failure, and halved by each step that lowers the cost.
_DAMPING = 0.1
_MOST_RAISED = 6  # steps that raise the cost, after which no smaller ones are tried
_NEGLIGIBLE = 0.02  # converged below this fraction of the expected error: in the dark, steps stay small for long
_HESSIAN_PX = 0.25  # the Hessian is updated after steps above this


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """Accuracy of an alignment, and the agreement of the images."""

    information: FloatArray  # (8, 8) inverse covariance of p1..p8 of the homography, from the photons of both images
    noise_ratio: float  # mean squared residual relative to that of photon noise
    overlap: float  # fraction of the template that both see
    std_px: float  # expected error of a corner, in px of the layer
    patches: Patches | None  # where patches lie, in px of the layer; None without texture


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Aligned:
    """An aligned template."""

    template: Layer
    homography: Homography  # (3, 3), pixels of the template to pixels of the fixed layer
    pixels: int  # number of pixels that both see
    squares: float  # weighted sum of the squared residuals
    weights: float  # sum of the weights, the inverse variances of the residuals
    # residual and weight at the last step. They belong to the thread, and are valid until it aligns another template of this
    # shape
    buffers: Buffers

    @property
    def overlap(self) -> float:
        """Fraction of the template that both see."""
        return self.pixels / self.template.image.size

    def quality(self, camera_matrix: FloatArray | None) -> Quality:
        """Return how well the images agree, given K in px of the layer for a rotation; it overwrites the buffers."""
        # A Gaussian blur of standard deviation s leaves 1 / (4 pi s^2) of the variance of white noise.
        noise_ratio = self.squares / self.pixels * 4 * np.pi * self.template.blur_px**2
        shape = (self.template.image.shape[0], self.template.image.shape[1])
        sums = _sums_of_patches(self.template, self.buffers)
        information, std_px, common = information_of(
            self.template,
            self.buffers,
            self.homography,
            noise_ratio=noise_ratio,
            coordinates=_coordinates(shape),
        )
        patches = _patches_of(sums, self.homography, shape, common, noise_ratio) if np.isfinite(std_px) else None
        if camera_matrix is not None and np.isfinite(std_px):
            information, std_px = information_on_turn(information, self.homography, camera_matrix, shape)
        return Quality(information=information, noise_ratio=noise_ratio, overlap=self.overlap, std_px=std_px, patches=patches)


def align(
    template: Layer,
    fixed: Layer,
    homography: Homography,
    *,
    prior_mean: Homography,
    basis: FloatArray,
    tolerance_px: float,
    max_steps: int,
) -> Aligned | NotLocated:
    """Align a template to another layer of the same shape, from an initial map of its pixels to those of the other layer.

    `basis` (8, K) are the small changes of p1..p8 in unit coordinates that are estimated. It has converged when a step moves no
    corner further than `tolerance_px`.
    """
    shape = (template.image.shape[0], template.image.shape[1])
    buffers = buffers_of(template)
    status, homography, pixels, squares, weights = _descend(
        template,
        fixed,
        homography,
        prior_mean,
        _coordinates(shape),
        basis,
        tolerance_px,
        max_steps,
        buffers,
    )
    if status == _CONVERGED:
        return Aligned(
            template=template, homography=homography, pixels=pixels, squares=squares, weights=weights, buffers=buffers
        )
    if status == _DIVERGED:
        return NotLocated(f"the alignment diverges: {why_implausible(homography, shape, 0.0)}")
    if status == _FLAT:
        return NotLocated(NO_TEXTURE)
    return NotLocated(f"the alignment has not converged after {max_steps} steps")


@cache
def _coordinates(shape: tuple[int, int]) -> Coordinates:
    homogeneous = np.concatenate([corners(shape), np.ones((4, 1))], axis=1).T
    to_corners = np.ascontiguousarray(slopes(homogeneous, generators(shape) @ homogeneous))
    return Coordinates(np.array(unit_coordinates(shape)), np.array(generators(shape)), to_corners)


_of_thread = local()


def buffers_of(layer: Layer) -> Buffers:
    """Return the buffers of this thread for images of the shape of a layer."""
    shape = layer.image.shape
    buffers: dict[tuple[int, ...], Buffers] = _of_thread.__dict__.setdefault("buffers", {})
    if shape not in buffers:
        buffers[shape] = Buffers(*(np.empty(size, np.float32) for size in (shape, shape, (2, *shape))))
    return buffers[shape]


@compiled
def _descend(  # noqa: PLR0913, PLR0917
    moving: Layer,
    fixed: Layer,
    homography: Homography,
    prior_mean: Homography,
    coordinates: Coordinates,
    basis: FloatArray,
    tolerance_px: float,
    max_steps: int,
    buffers: Buffers,
) -> tuple[int, Homography, int, float, float]:
    """Align a template to an image of the same shape.

    Args:
        moving: the template.
        fixed: the other image.
        homography: (3, 3) initial map, pixels of the template to pixels of the fixed image.
        prior_mean: (3, 3) prior mean of the homography.
        coordinates: of the template.
        basis: (8, K) small changes in unit coordinates of the template that are estimated.
        tolerance_px: converged when the next step is expected to move no corner further.
        max_steps: step limit.
        buffers: filled by `residuals_and_moments` at the start of the last step.

    Returns:
        The exit status, the homography, and the result of `residuals_and_moments` at the start of the last step.
    """
    height, width = moving.image.shape
    half = max(height, width) / 2
    unit = coordinates.unit
    from_unit, to_prior_mean = inverse_homography(unit), product(unit, inverse_homography(prior_mean))
    moments_x, moments_y = np.empty((3, 3)), np.empty((3, 3))
    own, hessian = np.zeros((8, 8)), np.zeros((8, 8))
    of_basis, gradient = transposed(basis), np.empty((8, 1))
    std_px, hessian_is_current = 0.0, False
    damping, previous, least_cost, last_px = 0.0, homography, np.inf, 0.0
    raised, pixels, squares, weights = 0, 0, 0.0, 0.0
    for _ in range(max_steps):
        pixels, squares, weights = residuals_and_moments(moving, fixed, homography, buffers, moments_x, moments_y)
        if pixels == 0:
            return _FLAT, homography, pixels, squares, weights
        if not hessian_is_current:
            floor = min(0.5, _MIN_CURVATURE * chance_level(pixels, moving.blur_px))
            own, hessian, _ = curvatures(moving, buffers, 0.0, floor)
            for i in range(8):
                for j in range(8):
                    hessian[i, j] += PRIOR[i, j]
            std_px, hessian_is_current = expected_px(hessian, basis, coordinates.to_corners), True
        deviation = _parameters(product(product(to_prior_mean, homography), from_unit))
        prior_gradient = applied(PRIOR, deviation)
        cost = (squares + dot(deviation, prior_gradient)) / pixels
        for k in range(8):
            image_gradient = dot(MOMENTS_X[k], moments_x.reshape(-1)) + dot(MOMENTS_Y[k], moments_y.reshape(-1))
            gradient[k, 0] = half * image_gradient + prior_gradient[k]
        unknowns = product(of_basis, gradient)
        if not solve(product(of_basis, product(hessian + damping * own, basis)), unknowns):
            return _FLAT, homography, pixels, squares, weights
        p = product(basis, unknowns)[:, 0]
        step = product(product(from_unit, _from_parameters(p)), unit)
        step_px = _corner_px(step, height, width)
        if step_px > _HESSIAN_PX:
            hessian_is_current = False
        if cost > least_cost:
            # The last step raised the cost: repeat it with more damping.
            homography, least_cost, last_px, damping = previous, np.inf, 0.0, max(_DAMPING, 4 * damping)
            raised += 1
            continue
        if raised == _MOST_RAISED:
            # What overlaps changes the cost more than any step does, which damping would only make smaller.
            return _CONVERGED, homography, pixels, squares, weights
        previous, least_cost, damping = homography, cost, damping / 2
        homography = scaled_to_one(product(homography, inverse_homography(step)))
        # An alignment that passes through an impossible homography may return, but not to the true one.
        if violation(homography, height, width)[0]:
            return _DIVERGED, homography, pixels, squares, weights
        # Convergence is linear: the ratio of the next step to this one is that of this one to the last.
        if step_px * (min(1.0, step_px / last_px) if last_px > 0 else 1.0) < max(tolerance_px, _NEGLIGIBLE * std_px):
            return _CONVERGED, homography, pixels, squares, weights
        last_px = step_px
    return _MAX_STEPS, homography, pixels, squares, weights


@compiled
def _parameters(homography: Homography) -> FloatArray:
    p = np.empty(8)
    for i in range(8):
        # The matrix column by column: [[1 + p1, p3, p5], [p2, 1 + p4, p6], [p7, p8, 1]].
        row, column = (i % 2, i // 2) if i < 6 else (2, i - 6)
        p[i] = homography[row, column] / homography[2, 2] - (1.0 if row == column else 0.0)
    return p


@compiled
def _from_parameters(p: FloatArray) -> Homography:
    homography = np.zeros((3, 3))
    for i in range(3):
        homography[i, i] = 1
    for i in range(8):
        row, column = (i % 2, i // 2) if i < 6 else (2, i - 6)
        homography[row, column] += p[i]
    return homography


@compiled
def _corner_px(step: Homography, height: int, width: int) -> float:
    """Return the largest displacement of a corner of an image by a step."""
    largest = 0.0
    for x in (0.0, width - 1.0):
        for y in (0.0, height - 1.0):
            depth = step[2, 0] * x + step[2, 1] * y + step[2, 2]
            u = (step[0, 0] * x + step[0, 1] * y + step[0, 2]) / depth - x
            v = (step[1, 0] * x + step[1, 1] * y + step[1, 2]) / depth - y
            distance = np.sqrt(u * u + v * v) if depth > 0 else np.inf
            if not distance <= largest:
                largest = distance
    return largest


_LEAST_SEEN = 0.5  # share of a patch that both images must see
_TEXTURE = 0.02  # least curvature along a direction, relative to the patch's, that counts as texture
_LARGEST_PX = 2.0  # step, in px of the layer, beyond which the image is not linear in it
_SUMS = 9


def _sums_of_patches(template: Layer, buffers: Buffers) -> FloatArray:
    """Return the (P, 9) sums of `_add_up` over the patches of a template; residual and weight are those of its last step.

    Noise is what the shift of each patch leaves of the residuals around a pixel.
    """
    sums, (height, width) = np.zeros((PATCHES, PATCHES, _SUMS)), template.image.shape
    _add_up(template, buffers, sums)
    curvature = sums[..., [0, 1, 1, 2]].reshape(PATCHES, PATCHES, 2, 2)
    steps = (np.linalg.pinv(curvature, hermitian=True) @ sums[..., 3:5, None])[..., 0]
    spread = cv2.resize(steps.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    explained = template.gradients[0] * spread[..., 0] + template.gradients[1] * spread[..., 1]
    noise = local_noise(buffers.residual - explained, buffers.weight, template.blur_px)
    sums[:] = 0
    _add_up(template._replace(smoothed=template.smoothed * np.sqrt(noise)), buffers, sums)
    return sums.reshape(-1, _SUMS)


def _patches_of(sums: FloatArray, homography: Homography, shape: tuple[int, int], common: float, noise_ratio: float) -> Patches:
    """Return where the patches of an aligned template lie, in pixels of its layer.

    Args:
        sums: (P, 9) those of `_sums_of_patches`.
        homography: (3, 3) from the template to the other layer.
        shape: (height, width) of the layer.
        common: share of the curvature of the template that the scene has, not its noise.
        noise_ratio: mean squared residual relative to that of photon noise.
    """
    own, scatter = (sums[:, [xx, xx + 1, xx + 1, xx + 2]].reshape(-1, 2, 2) for xx in (0, 5))
    # Noise has the same curvature along all directions, and in all patches alike.
    seen, traces = sums[:, 8], np.trace(own, axis1=1, axis2=2)
    noise = (1 - common) * traces.sum() / max(seen.sum(), 1) * seen / 2
    values, vectors = np.linalg.eigh(own - noise[:, None, None] * np.eye(2))
    values = np.maximum(values, _TEXTURE * np.maximum(traces, 1e-9)[:, None])
    hessian = vectors @ (values[..., None] * np.swapaxes(vectors, -1, -2))
    steps = np.linalg.solve(hessian, sums[:, 3:5, None])[..., 0]
    # As for the whole template, the blur correlates the noise of neighbours: the step scatters by H^-1 M H^-1.
    information = hessian @ np.linalg.pinv(scatter, hermitian=True) @ hessian / noise_of(noise_ratio)
    usable = (seen >= _LEAST_SEEN * shape[0] * shape[1] / len(sums)) & (np.linalg.norm(steps, axis=1) < _LARGEST_PX)

    # A patch that is seen at x + step of the template is where the homography maps x; so its middle lies a step before.
    middles = patch_centres(shape)
    there = transform_points(homography, middles)
    shifts = transform_points(homography, middles - steps) - there
    depth = middles @ homography[2, :2] + homography[2, 2]
    to_template = np.linalg.inv((homography[:2, :2] - there[..., None] * homography[2, :2]) / depth[:, None, None])
    information = np.swapaxes(to_template, -1, -2) @ information @ to_template
    kept = usable[:, None]
    return Patches(np.where(kept, shifts, 0.0), np.where(kept[..., None], information, 0.0))


@compiled
def _add_up(template: Layer, buffers: Buffers, sums: FloatArray) -> None:
    """Add up (rows, columns, 9) sums over the pixels of each patch, with the gradient g, residual r and weight w of a pixel.

    They are w times the products xx, xy, yy of g; w r g; w^2 times the products of the smoothed g; and the number of pixels
    that both images see.
    """
    height, width = template.image.shape
    rows, columns, _ = sums.shape
    for y in range(height):
        row = y * rows // height
        residual, weight = buffers.residual[y], buffers.weight[y]
        gx, gy, sx, sy = template.gradients[0][y], template.gradients[1][y], template.smoothed[0][y], template.smoothed[1][y]
        for column in range(columns):
            part = sums[row, column]
            first, last = -(-column * width // columns), -(-(column + 1) * width // columns)
            for x in range(first, last):
                w = weight[x]
                if w > 0:
                    wx, wy = w * gx[x], w * gy[x]
                    part[0] += wx * gx[x]
                    part[1] += wx * gy[x]
                    part[2] += wy * gy[x]
                    part[3] += wx * residual[x]
                    part[4] += wy * residual[x]
                    w2 = w * w
                    part[5] += w2 * sx[x] * sx[x]
                    part[6] += w2 * sx[x] * sy[x]
                    part[7] += w2 * sy[x] * sy[x]
                    part[8] += 1
