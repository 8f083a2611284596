"""Refine the motion by the shifts of short spans of frames, where they exceed photon noise: tremor inside a group."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, uniform_filter

from photonpano import BoolArray, FloatArray, PanoramaView, Refined, Source, SpanResiduals, Trajectory
from photonpano.filtering import SIGNIFICANT, SLOW, SYSTEMATIC_PX, WINDOW, Filtered, exceeding_noise
from photonpano.geometry import BLOCK_FRAMES, corners, inverse, normalised, step_motions, transform_points
from photonpano_core.configs import ShortSpansConfig

_FEWEST_SPANS = 16  # fewest spans that have a spectrum
# The light goes out, as between two flickers, if 5 % of the steps have 10 times the usual variance.
_DARK, _DARK_SHARE = 10.0, 0.05
_SMOOTH_SPANS = 16.0  # standard deviation of the Gaussian that smooths a trajectory, in spans
_NAMED_LINES = 3  # most frequencies named in a summary
_NAMED_SHARE = 0.003  # a frequency is named if its peak has at least this fraction of the power
# and if it exceeds the median of those about it so many times, as some hundred do by chance once in a hundred captures
_LINE = 15.0
_FEWEST_PERIODS = 6  # of a tremor in a capture; slower motion is the path
_SPEEDS = 0.15  # by how much the speed of the image may differ from the usual one
_ROUNDS = 6  # steps of expectation maximisation; more change the motion by less than its noise
_UNKNOWN = 1e6  # variance of an unknown value, relative to the median of the others
_NEIGHBOURS = 3, 5  # windows and frequencies over which the power is averaged to test it


class ShortSpansRefiner:
    """Corrects shift, roll and zoom of the frames by a Wiener filter of the steps of short spans.

    The spectrum of the steps is estimated in windows that overlap by half. The noise of the steps is known from the photons,
    so the spectrum of the motion is what exceeds it. Each frequency of each window is multiplied by signal / (signal + noise)
    if it is significant, by 0 if not (Wiener 1949).
    """

    def __init__(self, config: ShortSpansConfig, frame_shape: tuple[int, int], frame_rate_hz: float | None) -> None:
        """Take the (height, width) of a frame, and the frames per second, None if unknown."""
        self._config = config
        self._shape = frame_shape
        self._rate = frame_rate_hz
        self._radius_px = float(np.linalg.norm(corners(frame_shape)[0] - corners(frame_shape).mean(axis=0)))

    def refine(
        self, source: Source, trajectory: Trajectory, std_px: FloatArray, residuals: SpanResiduals, view: PanoramaView
    ) -> Refined | None:
        """Correct the motion: see `Refiner`."""
        del source, view
        if len(residuals.spans) < _FEWEST_SPANS:
            return None
        to_px = np.array([1, 1, self._radius_px, self._radius_px])
        variances = residuals.variances * to_px**2
        steps = residuals.steps * to_px
        instants = np.array([span.centre for span in residuals.spans])
        noise, wiggles = variances[:, 0], _wiggles(trajectory, instants, self._shape) * to_px
        if np.mean(noise > _DARK * np.median(noise)) > _DARK_SHARE:  # many steps are uncertain, as between two flickers
            modes = [_through_the_dark(*columns) for columns in zip(steps.T, wiggles.T, variances.T, strict=True)]
        else:
            modes = [exceeding_noise(*columns) for columns in zip(steps.T, variances.T, strict=True)]
        shift_px = float(np.sqrt(sum(np.mean(mode.signal**2) for mode in modes)))
        if shift_px < self._config.smallest_px:
            return None
        corrections = CubicSpline(instants, np.stack([mode.signal for mode in modes], axis=1) / to_px)
        tremor = np.stack([mode.signal for mode in modes[:2]], axis=1) + wiggles[:, :2]
        noise_px = np.interp(np.arange(len(std_px)), instants, np.sqrt(sum(mode.std**2 for mode in modes)))
        return Refined(
            self._corrected(trajectory, len(std_px), corrections, instants),
            np.hypot(std_px, noise_px),
            f"motion of {shift_px:.2g} px within groups was corrected{self._frequencies(tremor, trajectory, instants)}",
        )

    def _corrected(self, trajectory: Trajectory, n_frames: int, corrections: CubicSpline, instants: FloatArray) -> FloatArray:
        """Return the homographies of all frames, (T, 3, 3), moved by a spline of (shift x, shift y, roll, zoom)."""
        refined, from_reference = np.empty((n_frames, 3, 3)), np.empty(n_frames)
        for start in range(0, n_frames, BLOCK_FRAMES):
            frames = np.arange(start, min(start + BLOCK_FRAMES, n_frames))
            motions = trajectory.at(frames)
            from_reference[frames] = np.abs(motions - np.eye(3)).max(axis=(1, 2))
            refined[frames] = motions @ step_motions(corrections(np.clip(frames, instants[0], instants[-1])), self._shape)
        to_reference = inverse(refined[from_reference.argmin()])
        for start in range(0, n_frames, BLOCK_FRAMES):
            block = slice(start, start + BLOCK_FRAMES)
            refined[block] = normalised(to_reference @ refined[block])
        return refined

    def _frequencies(self, tremor: FloatArray, trajectory: Trajectory, instants: FloatArray) -> str:
        """Return the strongest frequencies of a tremor, (S, 2) in px, as the end of a sentence.

        Most of a slow tremor is known before, so that the correction alone would name what is left of it. A line stands out
        from the spectrum about it; it is neither a period of the path, nor that at which the image passes pixel after pixel.
        """
        spacing = float(np.median(np.diff(instants)))
        spectrum = np.fft.rfft(tremor * np.hanning(len(tremor))[:, None], axis=0)
        power = (np.abs(spectrum) ** 2).sum(axis=1)
        cycles = np.arange(len(power)) / (len(tremor) * spacing)
        place = transform_points(trajectory.at(instants), corners(self._shape).mean(axis=0)[None])[:, 0]
        passed = np.abs(np.diff(place, axis=0))  # pixels a span, whose fraction is what the spans show of their passing
        passing = np.median(np.abs(passed - np.round(passed)), axis=0) / spacing
        left, found = np.where(power > _NAMED_SHARE * power.sum(), power, 0), list[float]()
        left[:_FEWEST_PERIODS] = 0
        while len(found) < _NAMED_LINES and left.any():
            peak = int(left.argmax())
            about = np.r_[peak // 2 : peak - 2, peak + 3 : min(2 * peak, len(power))]
            passes = (np.abs(cycles[peak] - passing) < _SPEEDS * passing).any()
            if not passes and power[peak] > _LINE * np.median(power[about]):
                found.append(float(cycles[peak]))
            left[max(0, int(peak * 0.8) - 2) : int(peak * 1.25) + 3] = 0
        found.sort()
        if not found:
            return ""
        if self._rate is None:
            return f"; the image trembles with periods of {' and '.join(f'{1 / each:.0f}' for each in found)} frames"
        return f"; the image trembles at {' and '.join(f'{self._rate * each:,.0f}' for each in found)} Hz"


def _through_the_dark(steps: FloatArray, wiggles: FloatArray, variances: FloatArray) -> Filtered:
    """Filter one mode, (S,) steps in px, where the light goes out.

    The motion in the dark follows from that before and after, not from the steps, which vanish there once the trajectory is
    right. So the high-frequency part of the trajectory, `wiggles`, is added before filtering, and subtracted after.
    """
    size = min(WINDOW, len(steps))
    noise = variances + SYSTEMATIC_PX**2
    found = separated(wiggles + steps, noise, size)
    return Filtered(found.signal - wiggles, found.std)


def _wiggles(trajectory: Trajectory, instants: FloatArray, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the high-frequency part of a trajectory as steps: (S, 4), shift in px, roll in radians, and zoom."""
    homographies = trajectory.at(instants)
    middle = corners(frame_shape).mean(axis=0)
    points = transform_points(homographies, middle + np.array([[0.0, 0.0], [-0.5, 0.0], [0.5, 0.0]]))
    place, along = points[:, 0], points[:, 2] - points[:, 1]
    angle, size = np.unwrap(np.arctan2(along[:, 1], along[:, 0])), np.hypot(*along.T)
    parameters = np.column_stack([place, angle, np.log(size)])
    # Beyond its ends, the trajectory goes on as a mirror image through them.
    beyond = min(int(4 * _SMOOTH_SPANS), len(instants) - 1)
    longer = np.pad(parameters, ((beyond, beyond), (0, 0)), mode="reflect", reflect_type="odd")
    wiggles = parameters - gaussian_filter1d(longer, _SMOOTH_SPANS, axis=0, mode="nearest")[beyond : beyond + len(instants)]
    cosine, sine = np.cos(angle) / size, np.sin(angle) / size
    x, y = wiggles[:, 0].copy(), wiggles[:, 1].copy()
    wiggles[:, 0], wiggles[:, 1] = cosine * x + sine * y, cosine * y - sine * x
    return wiggles


def separated(values: FloatArray, variances: FloatArray, size: int) -> Filtered:
    """Estimate a motion (S,) whose spectrum is not known, in windows of `size` that overlap by half.

    In each window the motion is a Gaussian process. Its power at the frequencies that stand out from the noise is estimated by
    expectation and maximisation (Dempster et al. 1977), and the motion as its expectation (Wiener 1949), also where nothing was
    measured and the variance is infinite.
    """
    n = len(values)
    known = np.isfinite(variances)
    noise = np.where(known, variances, _UNKNOWN * float(np.median(variances[known])))
    measured = np.where(known, values, 0.0)
    starts = sorted({*range(0, n - size + 1, max(1, size // 2)), n - size})
    windows = [slice(start, start + size) for start in starts]
    standing = _standing_out([(measured[each], noise[each]) for each in windows])
    taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    signal, variance, total = np.zeros(n), np.zeros(n), np.zeros(n)
    for window, allowed in zip(windows, standing, strict=True):
        mean, spread = _expected(measured[window], noise[window], allowed)
        signal[window] += taper * mean
        variance[window] += taper * spread
        total[window] += taper
    return Filtered(signal / total, np.sqrt(np.maximum(variance / total, 0)))


def _standing_out(windows: list[tuple[FloatArray, FloatArray]]) -> BoolArray:
    """Return the frequencies of each window whose power exceeds that of the noise: (W, size + 1)."""
    lowest, floor = SLOW
    excess = []
    for values, noise in windows:
        precision = float((1 / noise).sum())
        power = np.abs(np.fft.rfft(values / noise, 2 * len(values))) ** 2 / precision
        power[: 2 * lowest] /= 1 + floor**2 * precision
        excess.append(power)
    return np.asarray(uniform_filter(np.array(excess), _NEIGHBOURS, mode="nearest") > SIGNIFICANT)


def _expected(values: FloatArray, noise: FloatArray, allowed: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the expected motion in a window, half of a period of the process, and its variance: (size,) each."""
    size, period = len(values), 2 * len(values)
    if not allowed.any():
        return np.zeros(size), np.zeros(size)
    lag = np.arange(size)[:, None] - np.arange(size)
    weight = 1 / noise
    power = np.full(len(allowed), max(float((weight * (values**2 - noise)).sum() / weight.sum()), 1e-12))
    power[~allowed] = 0
    for round_ in range(_ROUNDS + 1):
        covariance = np.fft.irfft(power, period)[np.abs(lag)]
        inverted = np.linalg.inv(covariance + np.diag(noise))
        if round_ == _ROUNDS:
            break
        amplitude = np.abs(np.fft.rfft(inverted @ values, period)) ** 2
        # The sums along the diagonals of the inverse have the spectrum of the information about each frequency.
        sums = np.bincount((lag % period).ravel(), inverted.ravel(), period)
        power = np.maximum(power + power**2 * (amplitude - np.fft.rfft(sums).real) / period, 0)
    mean = covariance @ (inverted @ values)
    return mean, covariance[0, 0] - np.einsum("ij,jk,ki->i", covariance, inverted, covariance, optimize=True)
