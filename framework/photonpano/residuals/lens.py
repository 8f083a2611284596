"""Find lens distortion in the mean shifts of blocks of the sensor, with what homographies and panorama absorb left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from photonpano.filtering import SYSTEMATIC_PX
from photonpano.geometry import corners, transform_points
from photonpano.residuals.block_sums import BLOCK_PX
from photonpano.values import FloatArray

_INSTANTS = 64  # instants of the motion at which the effect of a lens is computed


@dataclass(frozen=True, slots=True)
class LensDistortion:
    """Radial distortion, as residuals show it."""

    # displacement of a corner, relative to its distance from the centre; negative for a barrel. To first order: a strong
    # distortion is found too small.
    k1: float
    std: float  # its standard deviation
    # (N,) shifts in px by which frames, spread evenly over those located, follow a distortion of 1, and err
    bend_px: FloatArray

    @property
    def sigmas(self) -> float:
        """How significant it is."""
        return abs(self.k1) / self.std


def lens_distortion(
    shifts: FloatArray, information: FloatArray, homographies: FloatArray, frame_shape: tuple[int, int]
) -> LensDistortion | None:
    """Estimate radial distortion from the mean shifts of blocks against the panorama; None if there are too few blocks.

    The panorama averages the distortions of all frames that saw a place, and each homography follows the distortion as far as
    it can. What is left is a pattern over the sensor, which depends on the path and is computed here to first order. Its size
    in the shifts, (h, w, 2) px, is the distortion; their information, (h, w, 2, 2), is 0 for blocks without a shift.
    """
    known = information[..., 0, 0] > 0
    if known.sum() < _INSTANTS // 4 or len(homographies) < 2:
        return None
    pattern, bend_px = _pattern(known, homographies, frame_shape)
    covariance = np.linalg.inv(information[known]) + SYSTEMATIC_PX**2 * np.eye(2)
    weighted = np.linalg.solve(covariance, pattern[..., None])[..., 0]
    energy = float((pattern * weighted).sum())
    if energy < 1:
        return None
    # Shifts point from what the motion predicts to what the photons show.
    return LensDistortion(-float((weighted * shifts[known]).sum()) / energy, energy**-0.5, bend_px)


def _pattern(known: np.ndarray, homographies: FloatArray, frame_shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the mean shifts of blocks, in px, that a distortion of 1 would leave, (N, 2), and `bend_px`."""
    rows, columns = np.nonzero(known)
    height, width = frame_shape
    x = (columns * BLOCK_PX + np.minimum((columns + 1) * BLOCK_PX, width) - 1) / 2
    y = (rows * BLOCK_PX + np.minimum((rows + 1) * BLOCK_PX, height) - 1) / 2
    points = np.stack([x, y], axis=1)
    centre = corners(frame_shape).mean(axis=0)
    radius_px = float(np.linalg.norm(corners(frame_shape)[0] - centre))
    u, v = ((points - centre) / radius_px).T
    distortion = radius_px * (u**2 + v**2)[:, None] * np.stack([u, v], axis=1)
    zero, one = np.zeros_like(u), np.ones_like(u)
    along_x = np.stack([one, zero, u, v, zero, zero, u * u, u * v], axis=1)
    along_y = np.stack([zero, one, zero, zero, u, v, u * v, v * v], axis=1)
    moves = sparse.csr_array(np.concatenate([along_x, along_y]))

    instants = np.linspace(0, len(homographies) - 1, min(_INSTANTS, len(homographies))).astype(int)
    seen = transform_points(homographies[instants], points)
    cells = np.floor((seen - seen.min(axis=(0, 1))) / BLOCK_PX).astype(int)
    cell = (cells[..., 1] * (cells[..., 0].max() + 1) + cells[..., 0])[:, None, :] * 2 + np.arange(2)[:, None]
    place = np.unique(cell.ravel(), return_inverse=True)[1]
    # Observations: instant, then coordinate, then block.
    averages = sparse.csr_array((np.ones(len(place)), (np.arange(len(place)), place)))
    averages = averages @ sparse.diags_array(1 / np.sqrt(averages.sum(axis=0)))
    motions = sparse.block_diag([moves] * len(instants), format="csr")
    shared = averages.T @ motions
    observed = np.tile(distortion.T.ravel(), len(instants))
    normal = (motions.T @ motions - shared.T @ shared).toarray()
    right = motions.T @ observed - shared.T @ (averages.T @ observed)
    absorbed = motions @ np.linalg.lstsq(normal, right, rcond=1e-7)[0]
    left = observed - absorbed
    left -= averages @ (averages.T @ left)
    bend_px = np.linalg.norm(absorbed.reshape(len(instants), 2, -1).mean(axis=2), axis=1)
    return left.reshape(len(instants), 2, -1).mean(axis=0).T, bend_px


def deformation_px(shifts: FloatArray, information: FloatArray) -> float | None:
    """Return the root mean square of a smooth pattern in the shifts of blocks, beyond noise and a motion of the whole frame.

    Args:
        shifts: (h, w, 2) in px.
        information: (h, w, 2, 2) their inverse covariances by photon noise, 0 where a block carries no shift.

    Returns:
        The size of a cubic polynomial in px; None if no block carries a shift.
    """
    known = information[..., 0, 0] > 0
    if not known.any():
        return None
    noise = np.trace(np.linalg.inv(information[known]), axis1=-2, axis2=-1)
    # A shift, roll, zoom or shear of the whole frame is no deformation. Shifts that change from block to block are those of
    # edges, interpolated at different fractions of a pixel.
    rows, columns = (np.linspace(-1, 1, n)[index] for n, index in zip(known.shape, np.nonzero(known), strict=True))
    affine = np.stack([np.ones(len(rows)), columns, rows], axis=1)
    smooth = np.stack([columns**i * rows ** (power - i) for power in (2, 3) for i in range(power + 1)], axis=1)
    weights = 1 / np.sqrt(noise)[:, None]
    beyond = smooth - affine @ np.linalg.lstsq(affine * weights, smooth * weights)[0]
    fit = beyond @ np.linalg.pinv(beyond * weights) * weights.T
    return float(np.sqrt(max(float(np.mean(((fit @ shifts[known]) ** 2).sum(axis=-1) - fit**2 @ noise)), 0)))
