"""A gyroscope: its file of angular rates, the fit of their axes and time to a capture, and rotations as a prior of motion."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, LocationError
from photonpano.execution.context import Context
from photonpano.geometry import (
    ROTATION_AXES,
    Camera,
    FrameTrajectory,
    corner_displacements,
    corners,
    inverse,
    jacobian,
    nearest_rotations,
    normalised,
    right_handed_axes,
    rotation_matrices,
    rotation_vectors,
    slopes,
)
from photonpano.merging import binning_of
from photonpano.motion.level import Timeline
from photonpano.motion.pairs import GYROSCOPE, instants_of
from photonpano.motion.rotations import RotationTrajectory
from photonpano.motion.velocity import Contrast, Images, structure_of, varying_spans
from photonpano.text import pixels
from photonpano.values import Decision, Edge, FloatArray, Group, Homography, Located

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

    from photonpano.motion.graph import GraphSolution

_COLUMNS = "t_s, wx_rad_s, wy_rad_s, wz_rad_s, or wx_deg_s, wy_deg_s, wz_deg_s for degrees"
_FEWEST = 4
_FASTEST_RAD_S = 35.0  # 2,000 deg/s, the range of gyroscopes in phones and drones
_GAP = 5.0  # steps from one sample to the next that are longer than the median by this factor are gaps
_SCALE = 0.01  # expected error of the rates, and of the focal length, relative to them
_STIFF = 0.1  # expected departure of the corners from a rotation, relative to the error of the rotation
_CONTRADICTION = 5.0  # median of the differences between gyroscope and motion, in expected ones
_SIZE = 16  # spans of the shortest windows
_MOST_OFFSETS = 4000
_SIGNIFICANT = 6.0
_PULL = 0.15  # by how much of a step the contrast is pulled towards motions with a larger overlap
_STD_OFFSET_S = 1e-4  # of an offset that is given
_STD_BIAS, _MOST_BIAS = np.deg2rad(1.0), np.deg2rad(20.0)  # of gyroscopes of phones


@dataclass(frozen=True, eq=False)
class Rates:
    """Angular rates about the axes of the camera: x right, y down, z ahead; right-handed."""

    file: Path
    times_s: FloatArray  # (N,) increasing
    rad_s: FloatArray  # (N, 3)

    def about(self, axes: FloatArray) -> Rates:
        """Return the rates about other axes, the rows of (3, 3)."""
        return replace(self, rad_s=self.rad_s @ axes.T)

    def rotations(self, times_s: FloatArray, bias_rad_s: FloatArray) -> FloatArray:
        """Return the rotations from the camera at N increasing times to that at the first of them: (N, 3, 3).

        The rates are what was measured without the (3,) bias; before the first and after the last sample, the camera rests.
        """
        inside = np.clip(times_s, *self.times_s[[0, -1]])
        steps = rotation_matrices(np.diff(self._integral(inside) - inside[:, None] * bias_rad_s, axis=0))
        found = np.tile(np.eye(3), (len(inside), 1, 1))
        for index, step in enumerate(steps):
            found[index + 1] = found[index] @ step
        return found

    def require_covered(self, frames_s: FloatArray) -> None:
        """Raise an `InputError` if frames, at (T,) increasing times, lie before, after, or in a gap between the samples."""
        first, last = self.times_s[[0, -1]]
        if (lost := np.flatnonzero((frames_s < first) | (frames_s > last))).size:
            raise InputError(
                f"{self.file} holds rates from {first:g} to {last:g} s, and the frames were taken from {frames_s[0]:g} to "
                f"{frames_s[-1]:g} s: {len(lost)} of them, from {lost[0]} to {lost[-1]}, are without; correct "
                "motion.prior.time_offset_s, or leave them out (source: with: frames)"
            )
        steps = np.diff(self.times_s)
        for gap in np.flatnonzero(steps > _GAP * np.median(steps)):
            start, stop = np.searchsorted(frames_s, self.times_s[gap : gap + 2])
            if start < stop:
                raise InputError(
                    f"{self.file} holds no rates from {self.times_s[gap]:g} to {self.times_s[gap + 1]:g} s, when the frames "
                    f"{start} to {stop - 1} were taken; take those before or after (source: with: frames)"
                )

    @cached_property
    def _integral(self) -> PPoly:
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.times_s, self.rad_s).antiderivative()


def read_rates(file: Path) -> Rates:
    """Read the rates of a gyroscope, about its own axes, from a CSV file whose header names their units.

    Raises:
        InputError: the file cannot be read, lacks columns, its times do not increase, or its rates are impossible.
    """
    try:
        with file.open(encoding="utf-8-sig", newline="") as text:
            reader = csv.reader(text)
            names = [name.strip() for name in next(reader, ())]
            time = next((name for name in ("t_s", "time_s") if name in names), "")
            unit = next((unit for unit in ("rad_s", "deg_s") if {f"w{axis}_{unit}" for axis in "xyz"} <= set(names)), "")
            if not (time and unit):
                raise InputError(f"{file}: the first line must name the columns {_COLUMNS}; it is {','.join(names)!r}")
            columns = {name: names.index(name) for name in (time, *(f"w{axis}_{unit}" for axis in "xyz"))}
            numbers = np.array([*_samples(reader, columns, file)])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file} cannot be read: {error}") from error
    if len(numbers) < _FEWEST or not np.isfinite(numbers).all():
        raise InputError(f"{file} must hold at least {_FEWEST} samples, and no NaN or infinite numbers")
    times_s, rates = numbers[:, 0], numbers[:, 1:]
    if (back := np.flatnonzero(np.diff(times_s) <= 0)).size:
        raise InputError(f"{file}: {times_s[back[0] + 1]:.9g} s follows {times_s[back[0]]:.9g} s; sort its lines by time")
    rad_s = np.deg2rad(rates) if unit == "deg_s" else rates
    if (fastest := float(np.abs(rad_s).max())) > _FASTEST_RAD_S:
        degrees = "; if they are in deg/s, name the columns wx_deg_s, wy_deg_s, wz_deg_s" if unit == "rad_s" else ""
        raise InputError(f"{file} holds rates up to {fastest:.0f} rad/s, more than any usual gyroscope measures{degrees}")
    return Rates(file, times_s, rad_s)


def _samples(reader: Any, columns: dict[str, int], file: Path) -> Iterator[list[float]]:
    """Yield the numbers of each line of a `csv.reader` in some columns."""
    for row in filter(None, reader):
        try:
            yield [float(row[place]) for place in columns.values()]
        except (ValueError, IndexError):
            line, named = f"{file}, line {reader.line_num}", ", ".join(columns)
            raise InputError(f"{line}: expected a number for each of {named}, got {','.join(row)!r}") from None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Gyroscope:
    """Rates about the axes of the camera, and what was found of them."""

    rates: Rates
    camera: Camera
    frame_shape: tuple[int, int]  # (height, width) of a frame
    frames_s: FloatArray  # (T,) times of the frames by the clock of the gyroscope
    noise: float  # density of white noise, in rad/s per square root of Hz
    bias_rad_s: FloatArray  # (3,)
    std_bias_rad_s: FloatArray  # (3,)
    std_offset_s: float  # of the times of the frames

    def trajectory(self, reference: int) -> RotationTrajectory:
        """Return the motion of the frames by the rates alone."""
        rotations = self.rates.rotations(self.frames_s, self.bias_rad_s)
        return RotationTrajectory(FrameTrajectory(self.camera.homographies(rotations)), self.camera, reference)

    def edges(self, groups: Sequence[Group]) -> tuple[Edge, ...]:
        """Return the motion of each exposure to the one before, with the expected error of its rotation.

        Noise adds up as a random walk. Errors that stay the same, those of bias and scale, count as random walks that lead as
        far over the whole capture as they do.
        """
        times_s = np.interp(instants_of(groups), np.arange(len(self.frames_s)), self.frames_s)
        rotations = self.rates.rotations(times_s, self.bias_rad_s)
        between = np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:]
        vectors, seconds = rotation_vectors(between), np.diff(times_s)[:, None]
        angles, velocities = np.abs(vectors), vectors / np.maximum(seconds, 1e-12)
        variances = seconds * (self.noise**2 + self.std_bias_rad_s**2 * seconds.sum()) + _SCALE**2 * angles * angles.sum(axis=0)
        variances += (self.std_offset_s * np.diff(velocities, axis=0, prepend=velocities[:1])) ** 2
        motions = map(self._located, self.camera.homographies(between), variances)
        return tuple(Edge(index + 1, index, motion, GYROSCOPE) for index, motion in enumerate(motions))

    def _located(self, motion: Homography, variance: FloatArray) -> Located:
        """Return a motion with the (3,) variances of its rotation vector."""
        turned = self._of_corners(motion)
        std_px = float(np.sqrt((turned**2 @ variance).sum() / 4))
        covariance = turned * variance @ turned.T + (_STIFF * std_px) ** 2 * np.eye(8)
        by_parameters = jacobian(normalised(motion), corners(self.frame_shape)).reshape(8, 8)
        information = by_parameters.T @ np.linalg.inv(covariance) @ by_parameters
        return Located(normalised(motion), information, evidence={"std_px": std_px})

    def _of_corners(self, motion: Homography) -> FloatArray:
        """Return the derivatives of where a motion puts the corners by its rotation vector: (8, 3)."""
        rows = np.concatenate([corners(self.frame_shape), np.ones((4, 1))], axis=1).T
        return slopes(motion @ rows, motion @ self.camera.homographies(ROTATION_AXES) @ rows)

    def agreement(self, edges: Sequence[Edge], solution: GraphSolution, std_px: float) -> Decision:
        """Compare the gyroscope with the motion of exposures, of the given expected error, that was solved.

        Raises:
            InputError: they differ by much more than expected.
        """
        self._require_signs(edges)
        away, expected, weights = [0.0], [0.0], {True: 0.0, False: 0.0}
        for edge in edges:
            if not isinstance(edge.motion, Located) or edge.motion.information is None:
                continue
            motion, is_ours = edge.motion.homography, edge.locator == GYROSCOPE
            of_parameters = np.linalg.solve(jacobian(motion, corners(self.frame_shape)).reshape(8, 8), self._of_corners(motion))
            weights[is_ours] += float(np.trace(of_parameters.T @ edge.motion.information @ of_parameters))
            if is_ours:
                solved = inverse(solution.homographies[edge.fixed]) @ solution.homographies[edge.moving]
                away.append(float(corner_displacements(solved, motion, self.frame_shape).mean()))
                expected.append(float(np.hypot(edge.motion.evidence["std_px"], std_px)))
        px, expected_px = pixels(np.median(away)), pixels(np.median(expected))
        differs = f"{px} px from one exposure to the next, where {expected_px} px are expected"
        if np.median(away) > _CONTRADICTION * np.median(expected):
            raise InputError(
                f"{self.rates.file}: the rates contradict the images by {differs}; is it of this capture, and are "
                "motion.prior.axes, motion.prior.time_offset_s and camera.focal_px right?"
            )
        share = weights[True] / max(sum(weights.values()), 1e-12)
        reason = f"of what pairs of exposures show of rotations, {share:.0%} is by the gyroscope"
        return Decision("gyroscope_agreement", f"differs by {differs}", reason)

    def _require_signs(self, edges: Sequence[Edge]) -> None:
        """Raise an `InputError` if pairs of exposures turn about an axis in the opposite sense of the rates."""
        located = [(each, each.motion.homography) for each in edges if isinstance(each.motion, Located)]
        chain = [np.eye(3)]  # the rotations from each exposure to the first, by the rates
        for _, homography in (each for each in located if each[0].locator == GYROSCOPE):
            chain.append(chain[-1] @ self.camera.rotations(homography))
        pairs = [(edge, homography) for edge, homography in located if edge.locator != GYROSCOPE]
        seen = rotation_vectors(
            nearest_rotations(self.camera.rotations(np.array([each for _, each in pairs]).reshape(-1, 3, 3)))
        )
        told = rotation_vectors(np.array([chain[edge.fixed].T @ chain[edge.moving] for edge, _ in pairs]).reshape(-1, 3, 3))
        products, squares = seen * told, np.maximum((told**2).sum(axis=0), np.finfo(float).tiny)
        slope = products.sum(axis=0) / squares
        std = np.sqrt(((products - slope * told**2) ** 2).sum(axis=0)) / squares
        if (slope < -_SIGNIFICANT * std).any():
            axis = int(np.argmin(slope / np.maximum(std, np.finfo(float).tiny)))
            raise InputError(
                f"{self.rates.file}: about the axis {'xyz'[axis]} of the camera, pairs of exposures turn {-slope[axis]:.2g} "
                "times as far as the rates, the other way round; negate its column, or flip the frames if they are mirrored"
            )


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
    *,
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
    gyroscope = Gyroscope(
        rates=about[axes],
        camera=camera,
        frame_shape=info.frame_shape,
        frames_s=frames_s,
        noise=noise,
        bias_rad_s=motion[:3],
        std_bias_rad_s=std_bias,
        std_offset_s=std_offset_s,
    )
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
