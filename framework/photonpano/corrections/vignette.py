"""Estimate the vignette of a lens from a scene that moves through the frame, and divide sums of frames by it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from photonpano.geometry import apply, corner_displacements, inverse
from photonpano.protocols import LinearlyCorrectedSource, WeightedSource, camera_of
from photonpano.robust import huber_weights, robust_std
from photonpano.source_wrapper import (
    ColouredWrapper,
    LensedWrapper,
    PackedWrapper,
    SourceWrapper,
    WeightedWrapper,
    capabilities_of,
    with_capabilities,
)
from photonpano.values import Decision, FrameSpan, Homography

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.protocols import Source, Trajectory
    from photonpano.values import Counts, FloatArray, FluxImage

VIGNETTE_DECISION = "vignette_gain"
"""What a record names the decision to divide by a vignette."""
FLAT_FIELD_DECISION = "flat_field"
"""What a record names the decision to divide by a flat field."""
_SPANS, _SPAN_FRAMES, _SPAN_PX = 48, 64, 8.0
"""48 spans all over the capture are summed, each of at most 64 frames, in which the image moves by about 8 px at most."""
_CELL_PX = 8
"""Side of the squares of the sensor and of the scene that are compared, px."""
_POWERS = (2, 4, 6)
"""The logarithm of the gain is a polynomial of these powers of the distance from the middle of the frame."""
_ROUNDS = 6
"""The equations are solved this many times, with outliers down-weighted."""
_OUTLIER = 3.0
"""Standard deviations from which a square is down-weighted (Huber)."""
_LEAST_RMS = 0.03
"""Vignettes whose root mean square is smaller than this are left as they are: they cost nothing."""
_SURE = 6.0
"""Standard errors by which a vignette must differ from none. The structure of the scene within squares makes errors larger than
photon noise does, and correlated."""


@dataclass(frozen=True, slots=True, eq=False)
class Vignette:
    """The relative sensitivity of the pixels.

    Attributes:
        gain: (H, W) float32, 1 in the middle, or on average if it is a flat field.
        mean: (H, W) float32, mean count of a frame of each pixel, around which the division is linear.
        spans: the frames that it was estimated from.
        std: (H, W) float32, standard deviation of the gain, relative to it; None if it is not known.
    """

    gain: FluxImage
    mean: FluxImage
    spans: tuple[FrameSpan, ...]
    std: FluxImage | None = None

    @property
    def decision(self) -> Decision:
        """What was found, for the record."""
        corner, n_frames = float(self.gain[0, 0]), sum(map(len, self.spans))
        if self.std is not None:
            known = f"known to {np.median(self.std):.2g} in half of the frame, and to {self.std.max():.2g} everywhere"
            reason = f"root mean square of the differences in gain, from {n_frames} frames, {known}; the flux is divided by it"
            return Decision(FLAT_FIELD_DECISION, round(float(self.gain.std()), 3), reason)
        reason = f"light that reaches the corners, relative to the middle, from {n_frames} frames; the flux is divided by it"
        return Decision(VIGNETTE_DECISION, round(corner, 3), reason)


def estimate_vignette(source: Source, trajectory: Trajectory) -> Vignette | None:
    """Compare what different pixels saw of the same places.

    A square of the sensor with the gain g, which sees a place of the scene of the flux S in the light L of the time, gets the
    flux `g S L` on average. In logarithms these are linear equations with Poisson weights; S and L are eliminated.

    Args:
        source: a capture of binary frames.
        trajectory: its motion, known to a few pixels.

    Returns:
        None where there is no vignette, or nothing moves that could show it.
    """
    spans = _spans(source, trajectory)
    seen = [_Seen.of(source, span, trajectory) for span in spans]
    flux, weight = (np.concatenate([getattr(each, name) for each in seen]) for name in ("flux", "weight"))
    places = np.concatenate([each.places for each in seen])
    times = np.repeat(np.arange(len(seen)), [len(each.flux) for each in seen])
    distance = np.concatenate([each.distance for each in seen])
    if not flux.size:
        return None
    _, cells = np.unique(places, axis=0, return_inverse=True)
    shape = np.stack([distance**power for power in _POWERS], axis=-1)
    found = _solved(flux, weight, cells.ravel(), times, shape)
    if found is None:
        return None
    of_pixel = _distances(source.info.frame_shape, 1)
    log_gain = sum(float(each) * of_pixel**power for each, power in zip(found, _POWERS, strict=True))
    # No lens brightens the borders.
    if np.std(log_gain) < _LEAST_RMS or np.max(log_gain) > _LEAST_RMS:
        return None
    counts = np.sum([source.counts(span) for span in spans], axis=0) / sum(map(len, spans))
    return Vignette(np.exp(log_gain).astype(np.float32), counts.astype(np.float32), tuple(spans))


def divided_by(source: Source, vignette: Vignette) -> FlatSource:
    """Return a source whose corrected sums are those of a lens without vignette.

    It is a `WeightedSource` for a flat field, whose pixels may differ so far in gain that faint ones, which are multiplied
    most, would add more noise than light.
    """
    weighted = WeightedWrapper if vignette.std is None else _WeightedByGain
    known: tuple[type[SourceWrapper], ...] = (PackedWrapper, ColouredWrapper, LensedWrapper)
    capabilities = [each for each in capabilities_of(source) if each in known]
    if vignette.std is not None or isinstance(source, WeightedSource):
        capabilities.append(weighted)
    return with_capabilities(FlatSource, capabilities)(source, vignette)


class FlatSource(SourceWrapper):
    """A source whose sums are divided by a vignette: made by `divided_by`.

    A pixel of gain g is lit with the probability `p = 1 - exp(-g f)`, and without vignette with `q = 1 - (1 - p)^(1 / g)`. Sums
    are corrected linearly, around the mean of each pixel.
    """

    def __init__(self, source: Source, vignette: Vignette) -> None:
        super().__init__(source)
        self.vignette = vignette
        power = 1 / vignette.gain
        dark = np.maximum(1 - vignette.mean, np.float32(1e-3))
        self._slope = np.asarray(power * dark ** (power - 1), np.float32)
        self._offset = np.asarray(1 - dark**power - self._slope * (1 - dark), np.float32)

    def around(self, source: Source) -> FlatSource:
        """See `SourceWrapper`."""
        return divided_by(source, self.vignette)

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Take everything but the flux out of a sum of frames: see `LinearlyCorrectedSource`."""
        summed = self.wrapped.corrected(counts, n_frames) if isinstance(self.wrapped, LinearlyCorrectedSource) else counts
        return np.asarray(summed * self._slope + np.float32(n_frames) * self._offset, np.float32)


class _WeightedByGain(SourceWrapper):
    """What a source offers that is divided by a flat field."""

    vignette: Vignette

    def weights(self) -> FluxImage:
        """Return what a frame of each pixel is worth: the photons that it counts, of those of a pixel of gain 1."""
        own = self.wrapped.weights() if isinstance(self.wrapped, WeightedSource) else np.float32(1)
        return np.asarray(own * self.vignette.gain, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What the squares of the sensor saw in a span: N of them that saw photons.

    Attributes:
        flux: (N,) photons per pixel and frame.
        weight: (N,) inverse variance of its logarithm: photons.
        places: (N, 2) integers, the squares of the scene.
        distance: (N,) distance from the middle of the frame, relative to that of a corner.
    """

    flux: FloatArray
    weight: FloatArray
    places: NDArray[np.int64]
    distance: FloatArray

    @classmethod
    def of(cls, source: Source, span: FrameSpan, trajectory: Trajectory) -> _Seen:
        counts = source.counts(span)
        lit = source.corrected(counts, len(span)) if isinstance(source, LinearlyCorrectedSource) else counts
        photons, area = _binned(lit * source.valid), _binned(source.valid)
        seen = (area == _CELL_PX**2) & (photons > 0)
        distance, (rows, columns) = _distances(source.info.frame_shape, _CELL_PX)[seen], np.nonzero(seen)
        centres: FloatArray = (np.stack([columns, rows], axis=-1).astype(float) + 0.5) * _CELL_PX - 0.5
        places = _places(source, trajectory.at([span.centre])[0], centres)
        mean = np.asarray(photons[seen] / (area[seen] * len(span)), np.float32)
        flux = source.response.flux(mean, _CELL_PX**2 * len(span)).astype(float)
        return cls(flux, photons[seen], np.floor(places / _CELL_PX).astype(np.int64), distance)


def _places(source: Source, homography: Homography, points: FloatArray) -> FloatArray:
    """Return where (N, 2) pixels of a frame lie in the scene: (N, 2) on its plane, or around its camera if that is known."""
    camera = camera_of(source)
    if camera is None:
        return apply(homography, points)
    rays = camera.directions(points) @ (np.linalg.inv(camera.matrix) @ homography @ camera.matrix).T
    x, y, z = rays.T
    return camera.focal_px * np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)


def _spans(source: Source, trajectory: Trajectory) -> list[FrameSpan]:
    """Return spans all over the capture, so short that the image hardly moves in them."""
    info = source.info
    instants = np.linspace(0, info.n_frames - 1, _SPANS + 1)
    steps = inverse(trajectory.at(instants[:-1])) @ trajectory.at(instants[1:])
    moved = float(np.median(corner_displacements(steps, np.eye(3), info.frame_shape).max(axis=-1)))
    per_frame = moved * _SPANS / max(info.n_frames - 1, 1)
    n_frames = int(np.clip(_SPAN_PX / max(per_frame, 1e-9), 1, min(_SPAN_FRAMES, max(1, (info.n_frames - 1) // _SPANS))))
    return info.spread(_SPANS, n_frames)


def _solved(
    flux: FloatArray, weight: FloatArray, cells: NDArray[np.intp], times: NDArray[np.intp], shape: FloatArray
) -> FloatArray | None:
    """Solve `log flux = shape @ c + (a number for each cell) + (a number for each time)` for c.

    Args:
        flux: (N,) positive.
        weight: (N,) inverse variance of its logarithm.
        cells: (N,) index of the cell.
        times: (N,) index of the time.
        shape: (N, P).

    Returns:
        (P,); None if c does not differ from 0 with certainty.
    """
    n_cells, n_times, n_shape = cells.max() + 1, times.max() + 1, shape.shape[1]
    logarithm, robust = np.log(flux), np.ones_like(flux)
    for _ in range(_ROUNDS):
        w = weight * robust
        of_cell = np.maximum(np.bincount(cells, w, n_cells), 1e-12)

        def centred(values: FloatArray) -> FloatArray:
            return values - (np.bincount(cells, w * values, n_cells) / of_cell)[cells]  # noqa: B023

        within, target = np.stack([centred(column) for column in shape.T], axis=-1), centred(logarithm)
        light = np.bincount(cells * n_times + times, w, n_cells * n_times).reshape(n_cells, n_times)
        normal = np.zeros((n_shape + n_times, n_shape + n_times))
        normal[n_shape:, n_shape:] = np.diag(light.sum(axis=0)) - light.T @ (light / of_cell[:, None])
        normal[:n_shape, :n_shape] = within.T @ (w[:, None] * within)
        for k in range(n_shape):
            normal[k, n_shape:] = normal[n_shape:, k] = np.bincount(times, w * within[:, k], n_times)
        right = np.concatenate([within.T @ (w * target), np.bincount(times, w * target, n_times)])
        # The light of all times together is that of the scene; a capture that stands still leaves the shape free.
        normal[np.diag_indices_from(normal)] += 1e-6 * weight.sum()
        inverted = np.linalg.inv(normal)
        solution = inverted @ right
        if np.std(shape @ solution[:n_shape]) < _LEAST_RMS / 2:
            return None
        brightness = solution[n_shape:][times]
        left = (target - within @ solution[:n_shape] - centred(brightness)) * np.sqrt(weight)
        scale = max(robust_std(left), 1e-9)
        robust = huber_weights(left, _OUTLIER * scale)
    found, covariance = solution[:n_shape], inverted[:n_shape, :n_shape] * scale**2
    certain = float(found @ np.linalg.solve(covariance, found))
    return found if certain > n_shape * _SURE**2 else None


def _binned(image: NDArray[np.generic]) -> FloatArray:
    """Sum squares of pixels; those that the border cuts are left out."""
    height, width = (side // _CELL_PX for side in image.shape)
    part = np.asarray(image[: height * _CELL_PX, : width * _CELL_PX], float)
    return np.asarray(part.reshape(height, _CELL_PX, width, _CELL_PX).sum(axis=(1, 3)))


def _distances(frame_shape: tuple[int, int], side: int) -> FloatArray:
    """Return the distance of the centre of each square from the middle of the frame, relative to that of a corner."""
    height, width = frame_shape
    y, x = (((np.arange(length // side) + 0.5) * side - length / 2) for length in (height, width))
    return np.asarray(np.hypot(y[:, None], x[None, :]) / np.hypot(height / 2, width / 2))
