"""Divide sums of frames by the gain of the pixels: a flat field, or a vignette, which is estimated from a scene that moves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from photonpano.capture import Capture, LinearCorrection, capture_of
from photonpano.corrections.geometry import Correction, speed_px
from photonpano.errors import InputError
from photonpano.geometry import transform_points
from photonpano.photometry.images import sums_of_blocks
from photonpano.reading import read_arrays
from photonpano.robust import huber_weights, robust_std
from photonpano.values import Decision, FrameSpan, Homography

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from photonpano.contracts.protocols import Source, Trajectory
    from photonpano.corrections.geometry import Decide, Pixels
    from photonpano.values import FloatArray, FluxImage

VIGNETTE_DECISION, FLAT_FIELD_DECISION = "vignette_gain", "flat_field"  # names of the decisions in a record
VIGNETTE_FILE = "vignette.npz"
_SPANS, _SPAN_FRAMES = 48, 64  # spans all over the capture, and most frames of each
_SPAN_PX = 8.0  # the image moves by about this in a span, at most
_CELL_PX = 8  # side of the squares of the sensor and of the scene that are compared
_POWERS = (2, 4, 6)  # the logarithm of the gain is a polynomial of these powers of the distance from the middle of the frame
_ROUNDS = 6  # of iteratively reweighted least squares
_OUTLIER = 3.0  # standard deviations from which a square is down-weighted (Huber)
_LEAST_RMS = 0.03  # smaller vignettes (root mean square) cost nothing, and are ignored
_SURE = 6.0  # standard errors by which a vignette must differ from none: the scene within squares adds correlated errors


class FlatField(Correction):
    """Divides by the gain of the pixels, which the run measures after level 1 from a scene that moves through the frame."""

    name: ClassVar[str] = "flat-field"

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """See `Correction`: no pixel is moved or masked, and the gain is not known before the motion is."""
        del decide
        if capture.info.kind != "binary":
            raise InputError("flat-field divides sums of binary frames, and these frames are intensities; leave it out")
        return pixels


@dataclass(frozen=True, slots=True, eq=False)
class Vignette:
    """The relative sensitivity of the pixels."""

    gain: FluxImage  # (H, W) float32, 1 in the middle, or on average if it is a flat field
    mean: FluxImage  # (H, W) float32, mean count of a frame of each pixel, around which the division is linear
    spans: tuple[FrameSpan, ...]  # the frames that it was estimated from
    std: FluxImage | None = None  # (H, W) float32, standard deviation of the gain, relative to it; None for a vignette

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

    def correction(self) -> LinearCorrection:
        """Return the division of sums of frames.

        A pixel of gain g is lit with the probability `p = 1 - exp(-g f)`, and one of gain 1 with `q = 1 - (1 - p)^(1 / g)`.
        Sums are corrected from p to q, linearly around the mean of each pixel.
        """
        power, dark = 1 / self.gain, np.maximum(1 - self.mean, np.float32(1e-3))
        slope = np.asarray(power * dark ** (power - 1), np.float32)
        return LinearCorrection(slope, np.asarray(1 - dark**power - slope * (1 - dark), np.float32))


def divided_by(source: Source, vignette: Vignette) -> Capture:
    """Return a capture, with its colours, whose corrected sums are those of pixels of gain 1.

    Pixels of a flat field may differ so far in gain that faint ones, which are multiplied most, would add more noise than
    light: they are weighted by the photons that they count, relative to a pixel of gain 1.
    """
    capture = capture_of(source)

    def divided(each: Capture) -> Capture:
        # Channels have frames of their own.
        own = each.source is not capture.source
        mean = _mean_count(each, each.info.spread(_SPANS, _SPAN_FRAMES)) if own else vignette.mean
        correction = replace(vignette, mean=mean).correction()
        weight = each.weight
        if vignette.std is not None:
            weight = np.asarray(vignette.gain if weight is None else weight * vignette.gain, np.float32)
        return replace(each, steps=(*each.steps, correction), weight=weight)

    if capture.colour is None:
        return divided(capture)
    parts = {name: divided(each) for name, each in capture.colour.parts.items()}
    return replace(divided(capture), colour=replace(capture.colour, parts=parts))


def write_vignette(folder: Path, vignette: Vignette) -> None:
    """Write vignette.npz into a folder."""
    arrays = {"gain": vignette.gain, "mean": vignette.mean}
    if vignette.std is not None:
        arrays["std"] = vignette.std
    np.savez(folder / VIGNETTE_FILE, allow_pickle=False, **arrays)


def read_vignette(folder: Path, source: Source) -> Vignette | None:
    """Read the vignette of a run folder; None if there is none.

    Raises an `InputError` if the file is damaged, or of frames of another size.
    """
    path = folder / VIGNETTE_FILE
    if not path.exists():
        return None
    arrays = read_arrays(path, "the vignette of a run")
    shape = source.info.frame_shape
    for name in ("gain", "mean"):
        image = arrays.get(name)
        if image is None or image.dtype != np.float32 or image.shape != shape:
            held = "missing" if image is None else f"{image.dtype} of shape {image.shape}"
            raise InputError(f"{path}: {name} must be float32 of shape {shape}, as the frames, and is {held}; run again")
    return Vignette(arrays["gain"], arrays["mean"], (), arrays.get("std"))


def estimate_vignette(source: Source, trajectory: Trajectory) -> Vignette | None:
    """Compare what different pixels saw of the same places; None where there is no vignette, or no motion that could show it.

    A square of the sensor with the gain g, which sees a place of the scene of the flux S in the light L of the time, gets the
    flux `g S L` on average. In logarithms these are linear equations with Poisson weights; S and L are eliminated.
    """
    capture = capture_of(source)
    spans = _spans(capture, trajectory)
    seen = [_Seen.of(capture, span, trajectory) for span in spans]
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
    of_pixel = _distances(capture.info.frame_shape, 1)
    log_gain = sum(float(each) * of_pixel**power for each, power in zip(found, _POWERS, strict=True))
    # No lens brightens the borders.
    if np.std(log_gain) < _LEAST_RMS or np.max(log_gain) > _LEAST_RMS:
        return None
    return Vignette(np.exp(log_gain).astype(np.float32), _mean_count(capture, spans), tuple(spans))


def _mean_count(capture: Capture, spans: Sequence[FrameSpan]) -> FluxImage:
    """Return the mean count of a frame of each pixel in spans, (H, W), which corrections do not change."""
    counts = sum(each.astype(np.float32) for each in capture.chunks(spans))
    return np.asarray(counts / np.float32(sum(map(len, spans))), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What the squares of the sensor saw in a span: N of them that saw photons."""

    flux: FloatArray  # (N,) photons per pixel and frame
    weight: FloatArray  # (N,) inverse variance of its logarithm: photons
    places: NDArray[np.int64]  # (N, 2) integers, the squares of the scene
    distance: FloatArray  # (N,) distance from the middle of the frame, relative to that of a corner

    @classmethod
    def of(cls, capture: Capture, span: FrameSpan, trajectory: Trajectory) -> _Seen:
        valid = capture.masked_in(span).valid
        counts = capture.corrected_counts(span) * valid
        photons, area = (sums_of_blocks(np.asarray(each, float), _CELL_PX) for each in (counts, valid))
        seen = (area == _CELL_PX**2) & (photons > 0)
        distance, (rows, columns) = _distances(capture.info.frame_shape, _CELL_PX)[seen], np.nonzero(seen)
        centres: FloatArray = (np.stack([columns, rows], axis=-1).astype(float) + 0.5) * _CELL_PX - 0.5
        places = _places(capture, trajectory.at([span.centre])[0], centres)
        mean = np.asarray(photons[seen] / (area[seen] * len(span)), np.float32)
        flux = capture.response.flux(mean, _CELL_PX**2 * len(span)).astype(float)
        return cls(flux, photons[seen], np.floor(places / _CELL_PX).astype(np.int64), distance)


def _places(capture: Capture, homography: Homography, points: FloatArray) -> FloatArray:
    """Return where (N, 2) pixels of a frame lie in the scene: (N, 2) on its plane, or around its camera if that is known."""
    camera = capture.camera
    if camera is None:
        return transform_points(homography, points)
    rays = camera.directions(points) @ (np.linalg.inv(camera.matrix) @ homography @ camera.matrix).T
    x, y, z = rays.T
    return camera.focal_px * np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)


def _spans(capture: Capture, trajectory: Trajectory) -> list[FrameSpan]:
    """Return spans all over the capture, so short that the image hardly moves in them."""
    info = capture.info
    longest = min(_SPAN_FRAMES, max(1, (info.n_frames - 1) // _SPANS))
    n_frames = int(np.clip(_SPAN_PX / max(speed_px(capture, trajectory), 1e-9), 1, longest))
    return capture.shown(info.spread(_SPANS, n_frames))


def _solved(
    flux: FloatArray, weight: FloatArray, cells: NDArray[np.intp], times: NDArray[np.intp], shape: FloatArray
) -> FloatArray | None:
    """Solve `log flux = shape @ c + (a number for each cell) + (a number for each time)` for c, (P,); None if c may be 0.

    All arrays are (N,), but `shape` (N, P); `weight` is the inverse variance of the logarithm of the flux, which is positive.
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


def _distances(frame_shape: tuple[int, int], side: int) -> FloatArray:
    """Return the distance of the centre of each square from the middle of the frame, relative to that of a corner."""
    height, width = frame_shape
    y, x = (((np.arange(length // side) + 0.5) * side - length / 2) for length in (height, width))
    return np.asarray(np.hypot(y[:, None], x[None, :]) / np.hypot(height / 2, width / 2))
