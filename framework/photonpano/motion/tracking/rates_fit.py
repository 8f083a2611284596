"""Fit the rates of a gyroscope to a capture: those are right along which photons of different frames fit together best."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, LocationError
from photonpano.execution.context import Context
from photonpano.geometry import Camera, right_handed_axes
from photonpano.merging import binning_of
from photonpano.motion.gyroscope import GYROSCOPE, Gyroscope
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

    def __init__(self, images: Images, size: int, rates: Rates, camera: Camera, spans_s: FloatArray) -> None:
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
    period_s, last_s = float(np.median(np.diff(spans_s))), measured.times_s[-1] - frames_s[-1]
    offsets = np.arange(measured.times_s[0], last_s, period_s) if offset_s == "find" else np.array([offset_s])
    if not 0 < len(offsets) <= _MOST_OFFSETS:
        raise InputError(
            f"{file} covers {np.ptp(measured.times_s):g} s, and the capture takes {frames_s[-1]:g} s: to find the time offset, "
            f"at least as many and at most {_MOST_OFFSETS * period_s:g} s more are needed; give motion.prior.time_offset_s"
        )
    if offset_s != "find":
        measured.require_covered(frames_s + offset_s)
        spans_s = spans_s + offset_s
    every = right_handed_axes()
    about = {text: measured.about(every[text]) for text in (every if axes == "find" else [axes])}

    def along(rates: Rates, size: int) -> _AlongRates:
        return _AlongRates(images, size, rates, camera.scaled(1 / binning_of(source)), spans_s)

    size = min(_SIZE, len(images))
    motions = [np.array([0.0, 0.0, 0.0, *([start_s] if offset_s == "find" else [])]) for start_s in offsets]
    tried = [(text, motion) for text in about for motion in motions]
    heights = list(context.in_order(partial(_height, {text: along(rates, size) for text, rates in about.items()}), tried))
    axes, motion = tried[int(np.argmax(heights))]
    start = motion
    while True:
        fitted = along(about[axes], size)
        motion = fitted.sharpest(motion)
        if 2 * size > len(images) or fitted.moved_px(motion) > fitted.middle.min():
            break
        size *= 2
    opposite = along(about[axes].about(-np.eye(3)), size).of_spans(np.array([*-motion[:3], *motion[3:]]))
    better = fitted.of_spans(motion) - opposite
    significance = float(better.sum() / max(np.sqrt((better**2).sum()), 1e-12))
    if significance < _SIGNIFICANT or np.abs(motion[:3]).max() > _MOST_BIAS:
        raise LocationError(
            f"motion.prior: photons do not fit together along the rates of {file}: they stand out by {significance:.2g} "
            f"standard deviations from those along opposite rates (needed are {_SIGNIFICANT:g}), at a bias of "
            f"{np.rad2deg(np.abs(motion[:3]).max()):.2g} deg/s; is the file of this capture, are its units and "
            "motion.prior.axes right, and does the camera turn?"
        )
    # Slower motions have a larger overlap, and what photons leave open is as usual of gyroscopes.
    shown = np.linalg.inv(fitted.covariance(motion) + np.diag((_PULL * fitted.steps[: len(motion)]) ** 2))
    covariance = np.linalg.inv(shown + np.diag([*[_STD_BIAS**-2] * 3, (size * period_s) ** -2][: len(motion)]))
    usual = np.array([0.0, 0.0, 0.0, *start[3:]])
    motion = usual + covariance @ shown @ (motion - usual)
    *std_bias, std_offset_s = [*np.sqrt(np.diag(covariance)), _STD_OFFSET_S][:4]
    found_s = float(motion[3]) if offset_s == "find" else offset_s
    frames_s = frames_s + found_s
    about[axes].require_covered(frames_s)
    bias = ", ".join(f"{value:.3g} +- {std:.1g}" for value, std in np.rad2deg([motion[:3], std_bias]).T)
    text = f"time offset {found_s:.6g} +- {std_offset_s:.1g} s, axes ({axes}), bias ({bias}) deg/s"
    reason = f"photons along its rates stand out by {significance:.2g} standard deviations from those along opposite ones"
    gyroscope = Gyroscope(about[axes], camera, info.frame_shape, frames_s, noise, motion[:3], np.array(std_bias), std_offset_s)
    return gyroscope, Decision(GYROSCOPE, text, reason)


def _height(along: dict[str, _AlongRates], tried: tuple[str, FloatArray]) -> float:
    """Return the contrast along rates about some axes."""
    axes, motion = tried
    return float(along[axes].of_spans(motion).sum())
