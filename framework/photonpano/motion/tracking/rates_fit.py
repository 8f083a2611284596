"""Fit the rates of a gyroscope to a capture: those are right along which photons of different frames fit together best."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, LocationError
from photonpano.execution.context import Context
from photonpano.geometry import Camera, right_handed_axes
from photonpano.merging import binning_of
from photonpano.motion.gyroscope import Gyroscope
from photonpano.motion.pairs import GYROSCOPE
from photonpano.motion.rates import Rates, read_rates
from photonpano.motion.timeline import Timeline
from photonpano.motion.tracking.velocity import Contrast, Images, structure_of, varying_spans
from photonpano.values import Decision, FloatArray

_SIZE = 16  # spans of the shortest windows
_MOST_OFFSETS = 4000
_SIGNIFICANT = 6.0
_PULL = 0.15  # by how much of a step the contrast is pulled towards motions with a larger overlap
_STD_BIAS, _MOST_BIAS = np.deg2rad(1.0), np.deg2rad(20.0)  # of gyroscopes of phones
_STD_OFFSET_S = 1e-4  # of an offset that is given


class _AlongRates(Contrast):
    """The contrast along rates: the unknowns are their bias in rad/s and, where it is sought, the time of the first frame."""

    def __init__(self, images: Images, camera: Camera, spans_s: FloatArray, rates: Rates, size: int) -> None:
        """Take the camera of binned pixels, and the (S,) times of the spans, without what is sought."""
        super().__init__(images, size)
        self._rates, self._camera, self._spans_s = rates, camera, spans_s[self.spans]

    def there(self, motion: FloatArray) -> FloatArray:
        rotations = self._rates.rotations(self._spans_s + sum(motion[3:]), motion[:3]).reshape(-1, self.size, 3, 3)
        return self._camera.homographies(np.swapaxes(rotations, -1, -2) @ rotations[:, self.size // 2, None])

    @property
    def steps(self) -> FloatArray:
        period_s, focal_px = float(np.median(np.diff(self._spans_s))), self._camera.focal_px
        turns = 2 / (period_s * self.size * np.array([focal_px, focal_px, self.middle.min()]))
        return np.array([*turns, period_s])


def fit_rates(
    source: Source,
    file: Path,
    camera: Camera,
    timeline: Timeline,
    context: Context,
    noise: float,
    axes: str,
    offset_s: float | Literal["find"],
) -> tuple[Gyroscope, Decision]:
    """Find the bias of a gyroscope, and what is to `find`: the axes of the camera in its own, and its time at the first frame.

    Raises:
        InputError: the file cannot be used, or does not cover the capture; or the capture has no frame rate.
        LocationError: photons do not fit together along the rates.
    """
    measured, info = read_rates(file), source.info
    if info.frame_rate_hz is None:
        raise InputError("motion.prior: a gyroscope needs the frame rate of the capture; give frame_rate_hz of the source")
    frames_s = timeline.times(np.arange(info.n_frames)) / info.frame_rate_hz
    varying, seen, n_frames = varying_spans(source, context)
    images = structure_of(varying, seen)
    spans_s = timeline.times((np.arange(len(images)) + 0.5) * n_frames - 0.5) / info.frame_rate_hz
    if offset_s == "find":
        starts = [np.array([0.0, 0.0, 0.0, start_s]) for start_s in _offsets_s(file, measured, frames_s, spans_s)]
    else:
        measured.require_covered(frames_s + offset_s)
        spans_s = spans_s + offset_s
        starts = [np.zeros(3)]
    every = right_handed_axes()
    about = {text: measured.about(every[text]) for text in (every if axes == "find" else [axes])}
    along = partial(_AlongRates, images, camera.scaled(1 / binning_of(source)), spans_s)
    tried = [(text, start) for text in about for start in starts]
    shortest = {text: along(rates, min(_SIZE, len(images))) for text, rates in about.items()}
    axes, start = tried[int(np.argmax(list(context.in_order(partial(_height, shortest), tried))))]
    fitted, motion = _sharpened(partial(along, about[axes]), start, len(images))
    opposite = along(about[axes].about(-np.eye(3)), fitted.size).of_spans(np.array([*-motion[:3], *motion[3:]]))
    better = fitted.of_spans(motion) - opposite
    significance = float(better.sum() / max(np.sqrt((better**2).sum()), 1e-12))
    if significance < _SIGNIFICANT or np.abs(motion[:3]).max() > _MOST_BIAS:
        raise LocationError(
            f"motion.prior: photons do not fit together along the rates of {file}: they stand out by {significance:.2g} "
            f"standard deviations from those along opposite rates (needed are {_SIGNIFICANT:g}), at a bias of "
            f"{np.rad2deg(np.abs(motion[:3]).max()):.2g} deg/s (up to {np.rad2deg(_MOST_BIAS):.2g}); try axes: find; is the "
            "file of this capture, in the units that it names, and does the camera turn?"
        )
    motion, stds = _likeliest(fitted, motion, start)
    std_bias, std_offset_s = stds[:3], float(np.append(stds, _STD_OFFSET_S)[3])
    found_s = float(motion[3]) if offset_s == "find" else offset_s
    frames_s = frames_s + found_s
    about[axes].require_covered(frames_s)
    bias = ", ".join(f"{value:.3g} +- {std:.1g}" for value, std in np.rad2deg([motion[:3], std_bias]).T)
    text = f"time offset {found_s:.6g} +- {std_offset_s:.1g} s, axes ({axes}), bias ({bias}) deg/s"
    reason = f"photons along its rates stand out by {significance:.2g} standard deviations from those along opposite ones"
    gyroscope = Gyroscope(about[axes], camera, info.frame_shape, frames_s, noise, motion[:3], std_bias, std_offset_s)
    return gyroscope, Decision(GYROSCOPE, text, reason)


def _offsets_s(file: Path, measured: Rates, frames_s: FloatArray, spans_s: FloatArray) -> FloatArray:
    """Return the times of the first frame to try, at which the file covers the capture."""
    period_s = float(np.median(np.diff(spans_s)))
    offsets_s = np.arange(measured.times_s[0], measured.times_s[-1] - frames_s[-1], period_s)
    if not 0 < len(offsets_s) <= _MOST_OFFSETS:
        raise InputError(
            f"{file} covers {np.ptp(measured.times_s):g} s, and the capture takes {frames_s[-1]:g} s: the time offset is found "
            f"in files that cover it, and up to {_MOST_OFFSETS * period_s:g} s more; are the times in s? If so, give "
            "motion.prior.time_offset_s, or leave out what is far from the capture"
        )
    return offsets_s


def _height(along: dict[str, _AlongRates], tried: tuple[str, FloatArray]) -> float:
    """Return the contrast along rates about some axes."""
    axes, motion = tried
    return float(along[axes].of_spans(motion).sum())


def _sharpened(along: Callable[[int], _AlongRates], motion: FloatArray, n_spans: int) -> tuple[_AlongRates, FloatArray]:
    """Raise the contrast in longer and longer windows, until a window sees another place at its end; return the longest."""
    size = min(_SIZE, n_spans)
    while True:
        fitted = along(size)
        motion = fitted.sharpest(motion)
        if 2 * size > n_spans or fitted.moved_px(motion) > fitted.middle.min():
            return fitted, motion
        size *= 2


def _likeliest(fitted: _AlongRates, motion: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the motion if what photons leave open is as usual of gyroscopes, and its standard deviations."""
    # Slower motions have a larger overlap.
    shown = np.linalg.inv(fitted.covariance(motion) + np.diag((_PULL * fitted.steps[: len(motion)]) ** 2))
    usual = np.array([*[_STD_BIAS] * 3, fitted.size * fitted.steps[-1]])[: len(motion)] ** -2.0
    covariance = np.linalg.inv(shown + np.diag(usual))
    return start + covariance @ shown @ (motion - start), np.sqrt(np.diag(covariance))
