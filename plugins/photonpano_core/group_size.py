"""`group_size: auto`: groups as long as motion blur allows, and longer in the dark."""

from __future__ import annotations

import math
from collections.abc import Callable

from photonpano import CaptureSummary, Group, Resampler, StageContext, StreamInfo

_SHORTEST = {"binary": 16, "intensity": 1}  # frames of the shortest group that is chosen: fewer are too noisy
_BLUR = 0.15  # blur of a group at level 1, in shorter sides of a frame; twice as much spoils the result
_DARK_PHOTONS = 3.0  # photons per pixel below which groups get longer, since noise harms more than blur
_DARK_BLUR = 2.0  # factor on the blur that is allowed in the dark
_DIM_PHOTONS = 8.0  # photons per pixel below which groups are doubled once the motion is known
_DOUBLED_FROM = 3  # first level of doubled groups: by then tremor is known, whose period limits earlier groups
_BRIGHT_PHOTONS = 1000.0  # photons per pixel above which groups get shorter: less blur is worth more than more light
_BRIGHT_BLUR = 0.04  # blur below which groups do not get shorter, in shorter sides of a frame
_MIN_GROUPS = 8  # fewest groups at level 1 of a capture that is long enough
_NEARLY_WHOLE = 0.1  # a group that exceeds whole periods by less than this fraction of one is shortened to them
_MOST_LENGTHENED = 4  # longest period of the light that a group is lengthened to, in groups
_EPSILON = 1e-9  # floor on flux and speed in divisions
_DEFAULT_SIZE = 500  # frames of a group if the speed of the image is unknown


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
            size, reason = choose_group_size(capture, n_frames, min(stream.frame_shape), shortest_of(stream))
            if (lengthened := whole_periods(size, capture.period_frames, n_frames)) != size:
                reason += f"; {lengthened} are whole periods of the light, which each group then sees alike"
                size = lengthened
            self._doubled = self._densifies and capture.flux * size < _DIM_PHOTONS and n_frames // (2 * size) >= _MIN_GROUPS
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
    `shortest` frames, and the capture at least 8 groups.
    """
    if capture.speed_px is None:
        size, bound = _bounded(_DEFAULT_SIZE, n_frames, shortest)
        return size, f"{capture.how}, so {_DEFAULT_SIZE} frames are assumed{bound}"
    longest = _BLUR * shorter_side_px / max(capture.speed_px, _EPSILON)
    flux = max(capture.flux, _EPSILON)
    wanted, light = longest, ""
    if longest * flux < _DARK_PHOTONS:
        wanted, light = min(_DARK_PHOTONS / flux, _DARK_BLUR * longest), ", so few that more blur is allowed"
    elif longest * flux > _BRIGHT_PHOTONS:
        wanted, light = max(_BRIGHT_PHOTONS / flux, longest * _BRIGHT_BLUR / _BLUR), ", enough to shorten groups for less blur"
    size, bound = _bounded(wanted, n_frames, shortest)
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


def _bounded(wanted: float, n_frames: int, shortest: int) -> tuple[int, str]:
    """Return the nearest size that suits the capture, and a clause with the reason if it is not the wanted one."""
    longest = max(shortest, n_frames // _MIN_GROUPS)
    if wanted > longest:
        return longest, f"; of longer groups there would be fewer than {_MIN_GROUPS}"
    if wanted < shortest:
        return shortest, "; shorter groups would be mostly noise" if shortest > 1 else ""
    return round(wanted), ""
