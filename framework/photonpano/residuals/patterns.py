"""Patterns that residuals show: lens distortion, smooth deformation, and motion faster than a span of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.stats import norm

from photonpano.filtering import SYSTEMATIC_PX
from photonpano.geometry import corners, transform_points
from photonpano.residuals.block_sums import BLOCK_PX
from photonpano.values import FloatArray, FluxImage

_INSTANTS = 64  # instants of the motion at which the effect of a lens is computed
_SIGNIFICANT = 4.0  # standard deviations by which the scatter must exceed that of noise
_SMALLEST_PX = 0.02  # shaking by less than this stays within spans
_TURNS = 2, 3, 4, 8  # rows of which one may lie apart
_LENS_POWERS = 6  # of a polynomial over the lines of a sensor: a lens bends them by their fifth power
_LEAST_KNOWN = 1e-9  # of the information of all lines, below which a polynomial says all of a part
_FEWEST_SUMS = 2 * (_LENS_POWERS + 1)  # lines, or sums of neighbouring ones, whose scatter is measured
_FREQUENCIES = 256  # at which the spectrum is computed, up to half a cycle per frame


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


class PartsApart(NamedTuple):
    """Two parts of the sensor that see the scene at different places."""

    parts: str
    px: float
    sigmas: float
    frames: float = 0.0  # by which one is read later than the other, where that explains more than a shift
    turns: bool = False  # whether they are lines that take turns, which no motion follows one by one
    chance: float = 1.0  # that noise alone sets any of the parts that were compared as clearly apart


def parts_apart(slopes: FluxImage) -> PartsApart | None:
    """Return the parts of the sensor that lie beside each other most clearly; None where nothing shows it.

    They are rows that take turns, or rows and those before them, or columns; in the whole frame, or in a half of it, as where
    one quadrant is late. Each row lies elsewhere along x, y and time, by the slopes (6, H, W) of its pixels.
    """
    found, compared = list[PartsApart](), 0
    for lines, of_lines, across in (("rows", slopes, "columns"), ("columns", slopes.swapaxes(1, 2), "rows")):
        first, second = np.array_split(of_lines, 2, axis=2)
        half, length = first.shape[2], of_lines.shape[2]
        places = "", f", in {across} 0 to {half - 1}", f", in {across} {half} to {length - 1}"
        for part, place in zip((of_lines, first, second), places, strict=True):
            sums = np.asarray(part, np.float64).sum(axis=2)
            compared += len(sums) // 2 * (sum(_TURNS) + len(part[0]))
            speed = float(np.sqrt(2 * sums[4].sum() / max(float(sums[[0, 2]].sum()), 1e-12)))
            for information, right in (sums[:2], sums[2:4]):
                found += _lines_apart(information, right, lines, place)
            found += [
                late._replace(px=late.px * speed, frames=late.px) for late in _lines_apart(sums[4], sums[5], lines, place)
            ]
    best = max(found, key=lambda each: each.sigmas, default=None)
    return None if best is None else best._replace(chance=min(1.0, 2 * compared * float(norm.sf(best.sigmas))))


def _lines_apart(information: FloatArray, right: FloatArray, lines: str, place: str) -> list[PartsApart]:
    """Return how far lines that take turns lie beside the others, or lines from one on beside those before it.

    What a polynomial over the lines explains, such as a lens or a rolling shutter, is no difference of parts.
    """
    number = len(information)
    every, at = np.arange(number), np.linspace(-1, 1, number)
    smooth = np.polynomial.legendre.legvander(at, _LENS_POWERS - 1)
    normal = smooth.T @ (information[:, None] * smooth)
    if np.count_nonzero(information) < _FEWEST_SUMS or np.linalg.matrix_rank(normal) < len(normal):
        return []
    turns = [(each, first) for each in _TURNS for first in range(each if each > 2 else 1)]
    # 0 and 1 for lines that take turns; products with 0 and 1 for those from each on are sums over these.
    taken = np.array([every % each == first for each, first in turns], dtype=np.float64)
    weighted = np.column_stack([information[:, None] * smooth, right, information])
    products = np.concatenate([taken @ weighted, np.cumsum(weighted[::-1], axis=0)[-2::-1]])
    by_smooth, (by_right, squares) = products[:, :-2], products[:, -2:].T
    beyond = by_smooth @ np.linalg.inv(normal)
    left, known = by_right - beyond @ smooth.T @ right, squares - (beyond * by_smooth).sum(axis=1)
    told = np.divide(left**2, known, out=np.zeros(len(known)), where=known > _LEAST_KNOWN * information.sum())
    best = int(told.argmax())
    start = best - len(turns) + 1
    columns = np.column_stack([smooth, taken[best] if start <= 0 else every >= start])
    covariance = np.linalg.pinv(columns.T @ (information[:, None] * columns))
    away = covariance @ columns.T @ right
    scatter = _scatter(information, right - information * (columns @ away))
    parts = f"{lines} 0 to {start - 1} and {lines} {start} to {number - 1}"
    if start <= 0:
        each, first = turns[best]
        parts = f"odd and even {lines}" if each == 2 else f"one of {each} {lines}, from {first} on, and the others"
    sigmas = abs(float(away[-1])) / np.sqrt(covariance[-1, -1] * scatter)
    return [PartsApart(f"{parts}{place}", abs(float(away[-1])), float(sigmas), turns=start <= 0)]


def _scatter(information: FloatArray, left: FloatArray) -> float:
    """Return the scatter of what a fit leaves of lines over that of photon noise, 1 or more.

    Along a pan, a row sees the same edges all the time, at the same fraction of a pixel, and its neighbours see them, too: what
    they show is alike. So sums over 1, 2, 4, 8 lines are compared, and the largest scatter counts.
    """
    largest, size = 1.0, 1
    while len(left) // size >= _FEWEST_SUMS:
        starts = np.arange(0, len(left), size)
        variances = np.add.reduceat(information, starts)
        known = variances > 0
        squares = np.add.reduceat(left, starts)[known] ** 2 / variances[known]
        largest, size = max(largest, float(squares.sum()) / max(len(squares) - _LENS_POWERS - 1, 1)), 2 * size
    return largest


def deformation_px(shifts: FloatArray, information: FloatArray) -> float | None:
    """Return the root mean square of a smooth pattern in the shifts of blocks, beyond noise and a motion of the whole frame.

    It is the size of a cubic polynomial in px; None if no block carries a shift. The shifts are (h, w, 2) in px, `information`,
    (h, w, 2, 2), their inverse covariances by photon noise, 0 where a block carries none.
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


@dataclass(frozen=True, slots=True)
class Shaking:
    """What single frames of some windows show of motion that the spans average over."""

    size_px: float  # root mean square within a span, beyond a shift and a velocity of the span; 0 if noise explains it
    period_frames: float  # of the strongest frequency; NaN if nothing was found
    span_frames: int  # longest span within which no shaking is significant


def find_shaking(shifts: FloatArray, variances: FloatArray, size: int) -> Shaking:
    """Compare the scatter of single frames within spans of `size` frames with photon noise.

    The shifts, (W, F, 2) in px, are those of the F frames of each of W windows, at least `size`, against the panorama;
    `variances`, (W, F, 2), are theirs by photon noise.
    """
    found, span = scatter_px(shifts, variances, size), size
    if not found:
        return Shaking(0.0, float("nan"), size)
    # A shift and a velocity describe any two frames: spans that are so short measure single ones.
    while span > 2 and scatter_px(shifts, variances, span):
        span //= 2
    return Shaking(found, _period(shifts, variances), span if span > 2 else 1)


def scatter_px(shifts: FloatArray, variances: FloatArray, size: int) -> float:
    """Return the root mean square of shifts beyond a line through each `size` frames, and beyond noise; 0 if noise explains it.

    The mean square of n frames of a known variance has the standard deviation sqrt(2 / n) of that variance.
    """
    n_windows, n_frames, _ = shifts.shape
    pieces = n_frames // size
    free = size - 2
    if free < 1 or not pieces:
        return 0.0
    kept = shifts[:, : pieces * size].reshape(n_windows * pieces, size, 2)
    noise = variances[:, : pieces * size].reshape(n_windows * pieces, size, 2)
    known = np.isfinite(noise).all(axis=(1, 2))
    if not known.any():
        return 0.0
    line = np.stack([np.ones(size), np.arange(size)], axis=1)
    left = kept[known] - line @ (np.linalg.pinv(line) @ kept[known])
    squares, expected = (left**2).sum(axis=1) / free, noise[known].mean(axis=1)
    # Where one direction has little texture, its noise hides nothing that the other one shows.
    excess = (squares - expected).mean(axis=0)
    std = np.sqrt(2 / free * (expected**2).sum(axis=0)) / len(expected)
    significant = excess > _SIGNIFICANT * std
    size_px = float(np.sqrt(excess[significant].sum()))
    return size_px if size_px > _SMALLEST_PX else 0.0


def _period(shifts: FloatArray, variances: FloatArray) -> float:
    """Return the period in frames at which the power of the windows is largest."""
    n_frames = shifts.shape[1]
    frames = np.arange(n_frames)
    line = np.stack([np.ones(n_frames), frames], axis=1)
    left = np.nan_to_num(shifts - line @ (np.linalg.pinv(line) @ shifts))
    cycles = np.linspace(1 / n_frames, 0.5, _FREQUENCIES)
    waves = np.exp(-2j * np.pi * cycles[:, None] * frames) * np.hanning(n_frames + 2)[1:-1]
    power = (np.abs(waves @ left) ** 2).mean(axis=0)
    return float(1 / cycles[int((power / np.nanmedian(variances, axis=(0, 1))).sum(axis=1).argmax())])
