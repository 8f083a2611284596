"""Locator `kornia-registrator`: minimise the squared difference in brightness by L-BFGS through kornia's warper.

kornia's own `ImageRegistrator` has no masks and starts from the identity only. Its Adam steps stop 0.2 to 0.3 px from the
minimum that L-BFGS reaches on whitened parameters, or take thirty times as long. So only its warper is used here.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from kornia.filters import spatial_gradient
from kornia.geometry.transform import HomographyWarper
from skimage.registration import phase_cross_correlation

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import (
    corner_displacements,
    corners,
    inverse,
    jacobian,
    normalised,
    rescaled,
    translation,
    why_implausible,
)
from photonpano.locating import (
    NO_TEXTURE,
    NOTHING_SEEN,
    SMALLEST_SIDE,
    View,
    blur_against_noise,
    coarse_to_fine,
    free_parameters,
    motion_from_images,
    view_pyramid,
)
from photonpano_kornia.hooks import KorniaRegistratorConfig
from photonpano_kornia.runtime import device_of, image_on, one_thread

_COARSE_TOLERANCE = 4  # tolerance of coarser layers, which initialise the finest, relative to `converged_px`
_ROUNDS = 3  # most descents on a layer; the weights of pixels are updated in between


def unit_square(shape: tuple[int, int]) -> FloatArray:
    """Return the (3, 3) map from pixels to the coordinates of kornia's warper.

    -1 and 1 are the outer edges of the image, not the centres of its outermost pixels: `align_corners=False`.
    """
    height, width = shape
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


class RegistratorLocator:
    """Finds the homography under which two exposures differ least."""

    def __init__(self, config: KorniaRegistratorConfig) -> None:
        self._config = config
        self._device = device_of(config.device)
        # The first optimizer imports most of torch, which is not safe from several threads at once.
        torch.optim.LBFGS([torch.zeros(1, requires_grad=True)])

    def describe(self, exposure: VirtualExposure) -> tuple[View, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        blur_px = blur_against_noise(exposure, self._config.blur_px)
        return view_pyramid(exposure, blur_px, self._config.pyramid_levels, SMALLEST_SIDE)

    def register(self, moving: tuple[View, ...], fixed: tuple[View, ...], initial: Homography | None) -> Located | NotLocated:
        """Align; see `photonpano.Locator`."""
        if not (moving[-1].seen.any() and fixed[-1].seen.any()):
            return NotLocated(NOTHING_SEEN)
        start = initial
        if start is None:  # the shift of the coarsest images by masked cross-correlation (Padfield 2012)
            correlated: Callable[..., Any] = phase_cross_correlation
            one, other = moving[-1], fixed[-1]
            (down, right), *_ = correlated(other.image, one.image, reference_mask=other.seen, moving_mask=one.seen)
            start = rescaled(translation(float(right), float(down)), one.pixel)
        evaluations: list[int] = []
        found, failure = coarse_to_fine(moving, fixed, start, partial(self._aligned, len(moving), evaluations))
        if failure is not None:
            return failure
        evidence = {"evaluations": float(sum(evaluations))}
        return motion_from_images(moving[0], fixed[0], found[-1], self._config, evidence=evidence)

    def _aligned(
        self, layers: int, evaluations: list[int], moving: View, fixed: View, start: Homography, depth: int
    ) -> Homography | NotLocated:
        descent = _Descent(moving, fixed, free_parameters(depth, layers), self._device)
        with one_thread():
            found = descent.from_start(start, self._config, coarse=depth > 0)
        evaluations.append(descent.evaluations)
        return found


class _Descent:
    def __init__(self, moving: View, fixed: View, free: tuple[int, ...], device: torch.device) -> None:
        self._moving, self._fixed, self._free, self._device = moving, fixed, list(free), device
        self._here, self._there = image_on(device, moving.image), image_on(device, fixed.image)
        # The image is continued beyond its border, which would bias the alignment; weights mask these pixels.
        self._warper = HomographyWarper(*moving.shape, padding_mode="border", align_corners=False)
        self._unit = unit_square(moving.shape)
        self.evaluations = 0

    def from_start(self, homography: Homography, config: KorniaRegistratorConfig, coarse: bool) -> Homography | NotLocated:
        """Return the homography at the minimum, in pixels of the layer."""
        tolerance_px = config.converged_px * (_COARSE_TOLERANCE if coarse else 1)
        root: torch.Tensor | None = None
        for _ in range(_ROUNDS):
            there = self._fixed.seen_from(homography)
            both = self._moving.seen & there.seen
            # The inverse variances of the differences between pixels, 0 where one of them is masked.
            certainty = np.zeros(both.shape, np.float32)
            certainty[both] = 1 / (1 / self._moving.weight[both] + 1 / there.weight[both])
            weights = image_on(self._device, certainty)
            root = self._root_of_curvature(weights) if root is None else root
            if root is None:
                return NotLocated(NO_TEXTURE)
            previous, homography = homography, self._round(homography, weights, root, tolerance_px, config.max_iterations)
            if reason := why_implausible(homography, self._moving.shape, config.min_overlap):
                return NotLocated(f"the alignment diverges: {reason}")
            if corner_displacements(homography, previous, self._moving.shape).max() < tolerance_px:
                break
        return homography

    def _round(
        self,
        start: Homography,
        weights: torch.Tensor,
        root: torch.Tensor,
        tolerance_px: float,
        max_iterations: int,
    ) -> Homography:
        """Return the homography that minimises half the weighted sum of squared differences."""
        origin = torch.tensor(self._unit @ start @ inverse(self._unit), device=self._device)
        unit_loss = 2 * self._loss(origin, weights)
        if unit_loss == 0:
            return start
        # In these parameters the Hessian is the identity and the initial loss is 1/2. The first step of L-BFGS, which is one of
        # gradient descent, is then about a Gauss-Newton step.
        basis = torch.linalg.inv(root).T * torch.sqrt(unit_loss)
        # The largest displacement of a corner by a unit step of one of these parameters.
        unit_corners = corners(self._moving.shape) @ self._unit[:2, :2].T + self._unit[:2, 2]
        moved = jacobian(np.eye(3), unit_corners)[..., self._free] @ basis.cpu().numpy()
        corner_px = float(np.linalg.norm(moved * (np.array(self._moving.shape[::-1]) / 2)[:, None], axis=1).max())
        q = torch.zeros(len(self._free), dtype=torch.float64, device=self._device, requires_grad=True)
        optimizer = torch.optim.LBFGS(
            [q],
            max_iter=max_iterations,
            tolerance_grad=0,
            # torch compares it with the expected decrease of the loss too, which is the square of the step length.
            tolerance_change=(tolerance_px / corner_px) ** 2,
            line_search_fn="strong_wolfe",
        )

        def closure() -> torch.Tensor:
            optimizer.zero_grad()
            loss = self._loss(origin @ self._step(basis @ q), weights) / unit_loss
            loss.backward()
            return loss

        optimizer.step(closure)
        with torch.no_grad():
            found = (origin @ self._step(basis @ q)).cpu().numpy()
        return normalised(inverse(self._unit) @ found @ self._unit) if np.isfinite(found).all() else np.asarray(found)

    def _step(self, p: torch.Tensor) -> torch.Tensor:
        """Return the homography of the free parameters, in kornia's coordinates."""
        full = torch.zeros(8, dtype=torch.float64, device=self._device).index_put((torch.tensor(self._free),), p)
        p1, p2, p3, p4, p5, p6, p7, p8 = full
        one = torch.ones_like(p1)
        return torch.stack([1 + p1, p3, p5, p2, 1 + p4, p6, p7, p8, one]).reshape(3, 3)

    def _loss(self, to_fixed: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Return half the weighted sum of squared differences.

        `to_fixed` (3, 3) maps the moving image to the fixed one, in kornia's coordinates, as the warper maps its output to its
        input.
        """
        self.evaluations += 1
        warped = self._warper(self._there, to_fixed[None].to(torch.float32))
        return (weights * (warped - self._here) ** 2).sum(dtype=torch.float64) / 2

    def _root_of_curvature(self, weights: torch.Tensor) -> torch.Tensor | None:
        """Return the Cholesky factor of the Hessian of the loss, from the moving image; None without texture."""
        height, width = self._moving.shape
        along = spatial_gradient(self._here, mode="diff")[0, 0]
        gx, gy = along[0] * (width / 2), along[1] * (height / 2)
        x = torch.arange(width, device=self._device) * self._unit[0, 0] + self._unit[0, 2]
        y = torch.arange(height, device=self._device)[:, None] * self._unit[1, 1] + self._unit[1, 2]
        inwards = gx * x + gy * y
        slopes = torch.stack([gx * x, gy * x, gx * y, gy * y, gx, gy, -inwards * x, -inwards * y])[self._free]
        # Row by row: the rounding of a matrix product depends on MKL's number of threads.
        rows = [(slopes * (weights[0, 0] * slope)).sum(dim=(1, 2), dtype=torch.float64) for slope in slopes]
        root, failed = torch.linalg.cholesky_ex(torch.stack(rows))
        return None if failed else root
