"""`group_size: auto`: as long as motion blur allows, and longer in the dark."""

from __future__ import annotations

from collections.abc import Callable

from photonpano import CaptureSummary, Group, Resampler, StageContext
from photonpano_core.grouping import shortest_of

_BLUR = 0.15
"""Groups of the first level may be blurred by this share of the shorter side of a frame; twice as much spoils the result."""
_DARK = 3.0
"""Below so many photons a pixel noise does more harm than blur does, and groups get longer."""
_DIM = 8.0
"""Below so many, groups get longer once the motion is known, so that they are not blurred by it."""
_KNOWN_FROM = 3
"""From this level on even a trembling hand is known, whose period would forbid long groups before."""
_DARK_BLUR = 2.0
"""In the dark, so many times the blur is allowed."""
_SHARP = 0.04
"""Where light is plentiful, groups are so short that they are blurred by this share only; shorter ones tell no more."""
_PLENTY = 1000.0
"""So many photons a pixel are plenty."""
_GROUPS = 8
"""The first level has at least so many groups, where the capture is long enough."""
_LEAST = 1e-9
"""Flux and speed are at least this, so that they can be divided by."""
_UNKNOWN = 500
"""The group size if nothing tells how fast the image moves."""


class AutoResampler:
    """A resampler that chooses its group size when it is first asked for groups.

    Where groups get denser from level to level, those of a dim capture get twice as long once the motion is known.
    """

    def __init__(self, context: StageContext, of_size: Callable[[int], Resampler], densifies: bool) -> None:
        """Prepare to choose.

        Args:
            context: tells flux and speed, and is told the choice.
            of_size: makes the resampler with a group size.
            densifies: whether each level has twice as many groups as the one before.
        """
        self._context, self._of_size, self._densifies = context, of_size, densifies
        self._size: int | None = None
        self._doubled = False

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the groups of a level: see `photonpano.Resampler`.

        Raises:
            InputError: the capture is shorter than the shortest group.
        """
        if self._size is None:
            stream = self._context.stream
            capture = self._context.capture()
            size, reason = choose_group_size(capture, n_frames, min(stream.frame_shape), shortest_of(stream))
            self._doubled = self._densifies and capture.flux * size < _DIM and n_frames // (2 * size) >= _GROUPS
            if self._doubled:
                reason += f"; from level {_KNOWN_FROM} on, where the motion is known, groups are twice as long for more light"
            self._context.decide("group_size", size, reason)
            self._size = size
        # Groups twice as long, as dense as they would be at this level.
        twice = self._doubled and level >= _KNOWN_FROM
        return self._of_size(self._size * (2 if twice else 1)).groups(n_frames, level + (1 if twice else 0))


def choose_group_size(capture: CaptureSummary, n_frames: int, shorter_side_px: int, shortest: int) -> tuple[int, str]:
    """Return the group size for a capture, in frames, and a clause that gives the reason.

    The blur of a group of m frames at v px a frame is m v px. It may be 0.15 of the shorter side of a frame, and up to twice
    that as long as a pixel gets fewer than 3 photons; it is kept to 0.04 where a pixel gets 1000 all the same. There are at
    least `shortest` frames in a group, and at least 8 groups.
    """
    if capture.speed_px is None:
        size, bound = _bounded(_UNKNOWN, n_frames, shortest)
        return size, f"{capture.how}, so {_UNKNOWN} frames are assumed{bound}"
    allowed = _BLUR * shorter_side_px / max(capture.speed_px, _LEAST)
    photons = max(capture.flux, _LEAST)
    wanted, light = allowed, ""
    if allowed * photons < _DARK:
        wanted, light = min(_DARK / photons, _DARK_BLUR * allowed), ", so few that more blur is allowed"
    elif allowed * photons > _PLENTY:
        wanted, light = max(_PLENTY / photons, allowed * _SHARP / _BLUR), ", enough to shorten groups for less blur"
    size, bound = _bounded(wanted, n_frames, shortest)
    blur_px = size * capture.speed_px
    return size, (
        f"at {capture.speed_px:.2g} px per frame ({capture.how}) groups of {size} frame{'s' * (size > 1)} are blurred by "
        f"{blur_px:.3g} px, {blur_px / shorter_side_px:.2g} of the shorter side of a frame, and at a flux of "
        f"{capture.flux:.2g} hold {size * capture.flux:.3g} photons per pixel{light if size != shortest else ''}{bound}"
    )


def _bounded(wanted: float, n_frames: int, shortest: int) -> tuple[int, str]:
    """Return the nearest size that suits the capture, and what to say if it is not the one that was wanted."""
    most = max(shortest, n_frames // _GROUPS)
    if wanted > most:
        return most, f"; of longer groups there would be fewer than {_GROUPS}"
    if wanted < shortest:
        return shortest, "; shorter groups would be mostly noise" if shortest > 1 else ""
    return round(wanted), ""
