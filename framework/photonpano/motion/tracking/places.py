"""Where the registrations of the first level start: at the motion of short spans, then at that of the nearest exposures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from photonpano.geometry import corners, inverse, normalised, transform_points
from photonpano.motion.level import FrameHomography
from photonpano.motion.tracking.start import StartingMotion
from photonpano.values import FloatArray, Group, Homography


@dataclass(frozen=True, slots=True)
class Place:
    """Where an exposure lies."""

    segment: int  # number of the first exposure of those that are tied to this one
    homography: Homography  # (3, 3), pixels of its frame to those of that exposure's frame
    # (2,) shift of the middle of the image per frame period, px, along the last pair that was located; None where none was
    velocity: FloatArray | None


class Track:
    """The exposures of the first level, each tied to the nearest earlier one."""

    def __init__(
        self, start: StartingMotion | None, groups: Sequence[Group], frame_shape: tuple[int, int], places: Mapping[int, Place]
    ) -> None:
        """Take the motion that short spans show, all groups of the level, and the places of some of them."""
        self._start, self._groups = start, groups
        self._middle = corners(frame_shape).mean(axis=0)
        self.places = dict(places)  # where exposures lie, by their numbers: those that were given, and those settled since
        # of the pairs that may just as well have another motion, how far that is from the one they start at
        self.alternatives_px: dict[tuple[int, int], float] = {}

    def expected(
        self, place: Place | None, moving: int, fixed: int, hypotheses: Callable[[], Sequence[Homography]]
    ) -> FrameHomography | None:
        """Return where the registration of a pair starts: (3, 3); None if nothing is known.

        `place` is where `moving` lies, if one of its pairs was located before; `hypotheses` returns the motions that the two
        images themselves suggest, likeliest first.
        """
        there = self.places[fixed]
        if place is not None and place.segment == there.segment:
            return FrameHomography(normalised(inverse(there.homography) @ place.homography))
        instants = self._groups[moving].reference, self._groups[fixed].reference
        timeline = None if self._start is None else self._start.timeline
        if timeline is not None and timeline.is_dark_between(instants[1], instants[0]):
            return self._steadiest(hypotheses(), None, moving, fixed)
        if self._start is not None and (motion := self._start.between(*instants)) is not None:
            if alternative_px := self._start.alternative_px(*instants):
                self.alternatives_px[moving, fixed] = alternative_px
            return FrameHomography(motion)
        return self._steadiest(hypotheses(), there.velocity, moving, fixed)

    def placed(self, moving: int, fixed: int, motion: Homography) -> Place:
        """Return where an exposure lies by its motion to an earlier one."""
        there = self.places[fixed]
        velocity = self._shift(motion) / self._frames_between(moving, fixed)
        return Place(there.segment, normalised(there.homography @ motion), velocity)

    def settle(self, moving: int, place: Place | None) -> None:
        """Keep where an exposure lies; None for the first of its segment."""
        self.places[moving] = Place(moving, np.eye(3), None) if place is None else place

    def _steadiest(
        self, hypotheses: Sequence[Homography], velocity: FloatArray | None, moving: int, fixed: int
    ) -> FrameHomography | None:
        """Return the hypothesis nearest to the motion so far, or the likeliest at the start."""
        if not len(hypotheses):
            return None
        shifts = np.array([self._shift(each) for each in hypotheses])
        if velocity is None:
            if len(shifts) > 1:
                self.alternatives_px[moving, fixed] = float(np.linalg.norm(shifts[1] - shifts[0]))
            return FrameHomography(hypotheses[0])
        going_on = velocity * self._frames_between(moving, fixed)
        return FrameHomography(hypotheses[int(np.linalg.norm(shifts - going_on, axis=1).argmin())])

    def _frames_between(self, moving: int, fixed: int) -> float:
        return self._groups[moving].reference - self._groups[fixed].reference

    def _shift(self, motion: Homography) -> FloatArray:
        return np.asarray(transform_points(motion, self._middle[None])[0] - self._middle)
