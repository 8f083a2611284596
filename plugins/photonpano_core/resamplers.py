"""Resamplers: how a capture is divided into groups, and how groups get denser from level to level (paper, section 4)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from photonpano import CaptureSummary, FloatArray, FrameSpan, Group, InputError, Resampler, StageContext, StreamInfo
from photonpano_core.configs import GroupedConfig, MidpointConfig, SlidingWindowConfig, StratifiedConfig

_SHORTEST_END = 4  # frames of the shortest group at an end of the capture, where nothing else is measured
_SHORTEST = {"binary": 16, "intensity": 1}  # frames of the shortest group that is chosen: fewer are too noisy
_BLUR = 0.15  # blur of a group at level 1, in shorter sides of a frame; twice as much spoils the result
_DARK_PHOTONS = 3.0  # photons per pixel below which groups get longer, since noise harms more than blur
_DARK_BLUR = 2.0  # factor on the blur that is allowed in the dark
_DIM_PHOTONS = 8.0  # photons per pixel below which groups are doubled once the motion is known
_DOUBLED_FROM = 3  # first level of doubled groups: by then tremor is known, whose period limits earlier groups
_BRIGHT_PHOTONS = 1000.0  # photons per pixel above which groups get shorter: less blur is worth more than more light
_BRIGHT_BLUR = 0.04  # blur below which groups do not get shorter, in shorter sides of a frame
_MIN_GROUPS = 8  # fewest groups at level 1 that are lengthened for more light, or for whole periods of it
_SLOW_GROUPS = 16  # fewest groups of a long capture, however slow: between their instants, the motion is interpolated
_NEARLY_WHOLE = 0.1  # a group that exceeds whole periods by less than this fraction of one is shortened to them
_MOST_LENGTHENED = 4  # longest period of the light that a group is lengthened to, in groups
_AWAY = 0.5  # longest group as a share of the frames after which an image that returns is farthest away
_EPSILON = 1e-9  # floor on flux and speed in divisions
_DEFAULT_SIZE = 500  # frames of a group if the speed of the image is unknown


class ConstantGroupsResampler:
    """floor(n / m) groups of m frames at every level: the ablation that fails in the paper."""

    def __init__(self, config: GroupedConfig) -> None:
        if config.group_size == "auto":
            raise ValueError("group_size must be a number of frames here, not auto")
        self._config = config
        self._size = config.group_size

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the groups of a level, whose references are their centres; raises an `InputError` if none fits.

        They are spread evenly: the first starts at frame 0, and the last ends with the capture. Frames that do not fill a group
        are left out between groups, never at an end. No instant comes twice.
        """
        if problem := too_short(self._size, n_frames):
            raise InputError(problem)
        return tuple(Group(span, span.centre) for span in self._spans(n_frames, level))

    def _spans(self, n_frames: int, level: int) -> list[FrameSpan]:
        del level
        return self._at(self._evenly_spread(n_frames, n_frames // self._size))

    def _evenly_spread(self, n_frames: int, count: int) -> FloatArray:
        """Return evenly spaced starts of groups: (count,), in frames, with fractions; a single group lies in the middle."""
        last = n_frames - self._size
        return np.linspace(0, last, count) if count > 1 else np.array([last // 2], dtype=np.float64)

    def _at(self, starts: FloatArray) -> list[FrameSpan]:
        """Return spans that start at the nearest whole frames, each once."""
        return [FrameSpan(int(start), int(start) + self._size) for start in np.unique(np.rint(starts))]


class SlidingWindowResampler(ConstantGroupsResampler):
    """A group of m frames every s frames: the baseline of the paper (section 4, "Computational Considerations").

    With one step for all levels, the first level has as many groups as the last, O(n m / s) frames a level. Dense
    groups hardly help while the motion is inaccurate.
    """

    _config: SlidingWindowConfig

    def _spans(self, n_frames: int, level: int) -> list[FrameSpan]:
        first = max(1, self._size // 2) if self._config.step_frames is None else self._config.step_frames
        step = max(1.0, first / self._config.step_shrink ** (level - 1))
        return self._at(self._evenly_spread(n_frames, math.ceil((n_frames - self._size) / step) + 1))


class MidpointResampler(ConstantGroupsResampler):
    """Midpoint resampling (supplement S2): each further level adds a group between every two neighbours.

    Of k = floor(n / m) groups at level 1, there are 2k - 1 at level 2, and 4k - 3 at level 3. Each further level also adds a
    group of m / 2, m / 4, ... frames at each end, which halves the time beyond the outermost references.
    """

    _config: MidpointConfig

    def _spans(self, n_frames: int, level: int) -> list[FrameSpan]:
        spans = self._at(self._starts(n_frames, level))
        if not self._config.endpoints:
            return spans
        halves = [self._size >> step for step in range(level - 1, 0, -1) if self._size >> step >= _SHORTEST_END]
        first = [FrameSpan(0, half) for half in halves]
        return [*first, *spans, *(FrameSpan(n_frames - half, n_frames) for half in reversed(halves))]

    def _starts(self, n_frames: int, level: int) -> FloatArray:
        return self._evenly_spread(n_frames, (n_frames // self._size - 1) * 2 ** (level - 1) + 1)


class StratifiedResampler(MidpointResampler):
    """As many groups as `midpoint` at each level, each at random in its stratum: half-way to its neighbours there.

    Evenly spaced groups sample a tremor of the same period always at the same phase, and miss it (aliasing). Random groups do
    not. They depend on the seed, the level and the length of the capture alone.
    """

    _config: StratifiedConfig

    def __init__(self, config: StratifiedConfig, seed: int) -> None:
        super().__init__(config)
        self._seed = seed

    def _starts(self, n_frames: int, level: int) -> FloatArray:
        starts = super()._starts(n_frames, level)
        if len(starts) > 2:
            width = self._config.jitter * (starts[1] - starts[0])
            rng = np.random.default_rng([self._seed, level])
            starts[1:-1] += width * rng.uniform(-0.5, 0.5, len(starts) - 2)
        return starts


def too_short(group_size: int, n_frames: int) -> str | None:
    """Return the problem if a capture is shorter than a group; None if it is not."""
    if n_frames >= group_size:
        return None
    most, have = n_frames // 4, f"the capture has {n_frames} frame{'s' * (n_frames > 1)}"
    if not most:
        return f"{have}; a motion takes four or more"
    size = f"{most} or less" if most > 1 else "1"
    return f"{have}, fewer than one group of {group_size}; set group_size to {size}, so that at least four groups fit"


class AutoResampler:
    """A resampler that chooses its group size on the first call of `groups`, and records the decision.

    If each level has about twice as many groups as the one before, those of a dim capture are doubled once the motion is known.
    """

    def __init__(self, context: StageContext, of_size: Callable[[int], Resampler], densifies: bool) -> None:
        """Take a function that returns the resampler of a group size."""
        self._context, self._of_size, self._densifies = context, of_size, densifies
        self._size: int | None = None
        self._doubled = False

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the groups of a level: see `photonpano.Resampler`."""
        if self._size is None:
            stream = self._context.stream
            capture = self._context.capture()
            shortest = shortest_of(stream)
            size, reason = choose_group_size(capture, n_frames, min(stream.frame_shape), shortest)
            if capture.shortened > 1:
                size = max(shortest, size // capture.shortened)
                reason += f"; since such groups could not be located, they are shortened to {size}"
            if (lengthened := whole_periods(size, capture.period_frames, n_frames)) != size:
                reason += f"; {lengthened} are whole periods of the light, which each group then sees alike"
                size = lengthened
            # At both ends, half of a group is extrapolated, which fails where the motion returns within it.
            longest = n_frames // _MIN_GROUPS if capture.away_frames is None else _AWAY * capture.away_frames
            self._doubled = self._densifies and capture.flux * size < _DIM_PHOTONS and 2 * size <= longest
            if self._doubled:
                reason += f"; from level {_DOUBLED_FROM} on, where the motion is known, groups are twice as long for more light"
            self._context.decide("group_size", size, reason)
            self._size = size
        if self._doubled and level >= _DOUBLED_FROM:
            # Twice the length, at the density of this level.
            return self._of_size(2 * self._size).groups(n_frames, level + 1)
        return self._of_size(self._size).groups(n_frames, level)


def shortest_of(stream: StreamInfo) -> int:
    """Return the frames of the shortest group that is chosen."""
    return _SHORTEST[stream.kind]


def choose_group_size(capture: CaptureSummary, n_frames: int, shorter_side_px: int, shortest: int) -> tuple[int, str]:
    """Return the group size for a capture, in frames, and a clause with the reason.

    A group of m frames is blurred by m v px at v px per frame. The blur may be 0.15 of the shorter side of a frame; up to twice
    that while a pixel collects fewer than 3 photons; down to 0.04 while it collects more than 1000. A group has at least
    `shortest` frames, and the capture at least 16 groups. A motion that returns averages away in longer groups than a quarter
    of its period.
    """
    if capture.speed_px is None:
        size, bound = _bounded(_DEFAULT_SIZE, n_frames, shortest, capture.away_frames)
        return size, f"{capture.how}, so {_DEFAULT_SIZE} frames are assumed{bound}"
    longest = _BLUR * shorter_side_px / max(capture.speed_px, _EPSILON)
    flux = max(capture.flux, _EPSILON)
    wanted, light = longest, ""
    if longest * flux < _DARK_PHOTONS:
        wanted, light = min(_DARK_PHOTONS / flux, _DARK_BLUR * longest), ", so few that more blur is allowed"
    elif longest * flux > _BRIGHT_PHOTONS:
        wanted, light = max(_BRIGHT_PHOTONS / flux, longest * _BRIGHT_BLUR / _BLUR), ", enough to shorten groups for less blur"
    size, bound = _bounded(wanted, n_frames, shortest, capture.away_frames)
    blur_px = size * capture.speed_px
    return size, (
        f"at {capture.speed_px:.2g} px per frame ({capture.how}) groups of {size} frame{'s' * (size > 1)} are blurred by "
        f"{blur_px:.3g} px, {blur_px / shorter_side_px:.2g} of the shorter side of a frame, and at a flux of "
        f"{capture.flux:.2g} hold {size * capture.flux:.3g} photons per pixel{light if size != shortest else ''}{bound}"
    )


def whole_periods(size: int, period_frames: float | None, n_frames: int) -> int:
    """Return a group size that is lengthened to whole periods of flickering light (paper, section 6), in frames.

    It stays as it is in steady light, where a period is longer than 4 groups, and where there would be fewer than 8 groups.
    """
    if period_frames is None or period_frames > _MOST_LENGTHENED * size:
        return size
    lengthened = round(max(1, math.ceil(size / period_frames - _NEARLY_WHOLE)) * period_frames)
    return lengthened if lengthened <= n_frames // _MIN_GROUPS else size


def _bounded(wanted: float, n_frames: int, shortest: int, away_frames: float | None) -> tuple[int, str]:
    """Return the nearest size that suits the capture, and a clause with the reason if it is not the wanted one."""
    longest, bound = n_frames // _SLOW_GROUPS, f"; of longer groups there would be fewer than {_SLOW_GROUPS}"
    if away_frames is not None and _AWAY * away_frames < longest:
        longest = int(_AWAY * away_frames)
        bound = (
            f"; in longer ones the motion averages away, since the image is farthest after {away_frames:.0f} frames and returns"
        )
    longest = max(shortest, longest)
    if wanted > longest:
        return longest, bound
    if wanted < shortest:
        return shortest, "; shorter groups would be mostly noise" if shortest > 1 else ""
    return round(wanted), ""
