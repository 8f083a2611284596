"""Alignment by gradient descent through kornia's warper, coarse to fine.

kornia's own `ImageRegistrator` has no masks and no start other than the identity. Its steps of Adam stop 0.2 to 0.3 px from
where L-BFGS ends on parameters that are scaled until the loss is round, or take thirty times as long. So only its warper is
used here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from kornia.filters import spatial_gradient
from kornia.geometry.transform import HomographyWarper
from numpy.typing import NDArray
from skimage.registration import phase_cross_correlation

from photonpano import Located, NotLocated, VirtualExposure
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
from photonpano.locating import View, blur_against_noise, motion_from_images, view_pyramid
from photonpano_kornia.configs import KorniaRegistratorConfig
from photonpano_kornia.runtime import device_of, images_on, one_thread

_SMALLEST_SIDE = 24
"""The pyramid ends before an image gets smaller than this, in px."""
_ALL = (0, 1, 2, 3, 4, 5, 6, 7)
_COARSE_MODELS = ((4, 5), (0, 1, 2, 3, 4, 5))
"""Which of p1..p8 are free in the coarsest layer (shift) and in the next (affine): few pixels bear few parameters."""
_COARSE_TOLERANCE = 4
"""Coarse layers only start the finest, and may stop this much earlier."""
_ROUNDS = 3
"""How often the weights of pixels are taken anew at where a descent ended, at most."""


def unit_square(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the map from pixels to the coordinates of kornia's warper: (3, 3).

    Convention:
        Integer pixels are centres. -1 and 1 are the outer edges of the image, not the centres of its outermost pixels: in
        kornia's terms, `align_corners=False`.
    """
    height, width = shape
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


class RegistratorLocator:
    """Descends to the homography under which two exposures differ least."""

    def __init__(self, config: KorniaRegistratorConfig) -> None:
        self._config = config
        self._device = device_of(config.device)
        # The first optimizer imports the better part of torch, which threads must not do at the same time.
        torch.optim.LBFGS([torch.zeros(1, requires_grad=True)])

    def describe(self, exposure: VirtualExposure) -> tuple[View, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        blur_px = blur_against_noise(exposure, self._config.blur_px)
        return view_pyramid(exposure, blur_px, self._config.pyramid_levels, _SMALLEST_SIDE)

    def register(
        self, moving: tuple[View, ...], fixed: tuple[View, ...], initial: NDArray[np.float64] | None
    ) -> Located | NotLocated:
        """Align; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when no layer of the pyramid can be aligned, or when the images do not
            look alike where it ends.
        """
        if not (moving[-1].seen.any() and fixed[-1].seen.any()):
            return NotLocated("nothing was seen far enough from what was not")
        homography = _shifted(moving[-1], fixed[-1]) if initial is None else initial
        lost, evaluations = "", 0
        for depth in reversed(range(len(moving))):
            pixel = moving[depth].pixel
            descent = _Descent(moving[depth], fixed[depth], _free(depth, len(moving)), self._device)
            with one_thread():
                found = descent.from_start(rescaled(homography, 1 / pixel), self._config, coarse=depth > 0)
            evaluations += descent.evaluations
            if isinstance(found, str):
                # A layer that leads nowhere is passed over: the start may be good enough for the next, finer one.
                lost = found
            else:
                homography, lost = rescaled(found, pixel), ""
        if lost:
            return NotLocated(lost)
        return motion_from_images(moving[0], fixed[0], homography, self._config, evidence={"evaluations": float(evaluations)})


class _Descent:
    """The alignment of one layer."""

    def __init__(self, moving: View, fixed: View, free: tuple[int, ...], device: torch.device) -> None:
        self._moving, self._fixed, self._free, self._device = moving, fixed, list(free), device
        self._here, self._there = images_on(device, moving.image), images_on(device, fixed.image)
        # Beyond its edge the image goes on, so that no border pulls; which pixels count is a matter of weights.
        self._warper = HomographyWarper(*moving.shape, padding_mode="border", align_corners=False)
        self._unit = unit_square(moving.shape)
        self.evaluations = 0

    def from_start(
        self, homography: NDArray[np.float64], config: KorniaRegistratorConfig, coarse: bool
    ) -> NDArray[np.float64] | str:
        """Return the homography at the end of the descent, in px of the layer, or why there is none."""
        tolerance_px = config.converged_px * (_COARSE_TOLERANCE if coarse else 1)
        root: torch.Tensor | None = None
        for _ in range(_ROUNDS):
            weights = self._weights(homography)
            root = self._root_of_curvature(weights) if root is None else root
            if root is None:
                return "where the images overlap, if they do, there is no texture"
            before, homography = homography, self._round(homography, weights, root, tolerance_px, config.max_iterations)
            if reason := why_implausible(homography, self._moving.shape, config.min_overlap):
                return f"the alignment diverges: {reason}"
            if corner_displacements(homography, before, self._moving.shape).max() < tolerance_px:
                break
        return homography

    def _weights(self, homography: NDArray[np.float64]) -> torch.Tensor:
        """Return the inverse variances of the differences between pixels, 0 where one of them was not seen."""
        there = self._fixed.seen_from(homography)
        both = self._moving.seen & there.seen
        weight = np.zeros(both.shape, np.float32)
        weight[both] = 1 / (1 / self._moving.weight[both] + 1 / there.weight[both])
        return images_on(self._device, weight)

    def _round(
        self,
        start: NDArray[np.float64],
        weights: torch.Tensor,
        root: torch.Tensor,
        tolerance_px: float,
        max_iterations: int,
    ) -> NDArray[np.float64]:
        """Minimise half the weighted sum of squared differences, and return the homography where it is least."""
        origin = torch.tensor(self._unit @ start @ inverse(self._unit), device=self._device)
        unit_loss = 2 * self._loss(origin, weights)
        if unit_loss == 0:
            return start
        # In these parameters the curvature of the scene is the identity, and the loss is 1/2 at the start: L-BFGS, whose first
        # step is that of gradient descent, then begins with about the step of Gauss and Newton.
        basis = torch.linalg.inv(root).T * torch.sqrt(unit_loss)
        q = torch.zeros(len(self._free), dtype=torch.float64, device=self._device, requires_grad=True)
        optimizer = torch.optim.LBFGS(
            [q],
            max_iter=max_iterations,
            tolerance_grad=0,
            # torch compares the same number with how much a step would lower the loss, which is the square of its length.
            tolerance_change=(tolerance_px / self._corner_px(basis.cpu().numpy())) ** 2,
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

        Args:
            to_fixed: (3, 3), the moving image to the fixed one, in kornia's coordinates. That is the direction of the warper,
                too, which asks where a pixel of what it makes is to be looked up.
            weights: (1, 1, H, W).
        """
        self.evaluations += 1
        warped = self._warper(self._there, to_fixed[None].to(torch.float32))
        return (weights * (warped - self._here) ** 2).sum(dtype=torch.float64) / 2

    def _root_of_curvature(self, weights: torch.Tensor) -> torch.Tensor | None:
        """Return the Cholesky factor of the curvature of the loss, from the moving image; None without texture."""
        height, width = self._moving.shape
        along = spatial_gradient(self._here, mode="diff")[0, 0]
        gx, gy = along[0] * (width / 2), along[1] * (height / 2)
        x = torch.arange(width, device=self._device) * self._unit[0, 0] + self._unit[0, 2]
        y = torch.arange(height, device=self._device)[:, None] * self._unit[1, 1] + self._unit[1, 2]
        inwards = gx * x + gy * y
        slopes = torch.stack([gx * x, gy * x, gx * y, gy * y, gx, gy, -inwards * x, -inwards * y])[self._free]
        # Row by row: the sums of a product of matrices depend on the number of threads that MKL was given.
        rows = [(slopes * (weights[0, 0] * slope)).sum(dim=(1, 2), dtype=torch.float64) for slope in slopes]
        root, failed = torch.linalg.cholesky_ex(torch.stack(rows))
        return None if failed else root

    def _corner_px(self, basis: NDArray[np.float64]) -> float:
        """Return how far a unit step of one of the scaled parameters moves a corner at most, in px."""
        unit_corners = corners(self._moving.shape) @ self._unit[:2, :2].T + self._unit[:2, 2]
        moved = jacobian(np.eye(3), unit_corners)[..., self._free] @ basis
        return float(np.linalg.norm(moved * (np.array(self._moving.shape[::-1]) / 2)[:, None], axis=1).max())


def _shifted(moving: View, fixed: View) -> NDArray[np.float64]:
    """Return the shift between two images by masked cross-correlation (Padfield 2012), in px of the finest layer."""
    correlated: Callable[..., Any] = phase_cross_correlation
    (down, right), *_ = correlated(fixed.image, moving.image, reference_mask=fixed.seen, moving_mask=moving.seen)
    return rescaled(translation(float(right), float(down)), moving.pixel)


def _free(depth: int, layers: int) -> tuple[int, ...]:
    from_coarsest = layers - 1 - depth
    return _COARSE_MODELS[from_coarsest] if depth > 0 and from_coarsest < len(_COARSE_MODELS) else _ALL
