"""The interfaces of the components that estimate motion: the four steps of a level, and refiners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.contracts.protocols.sources import Source
from photonpano.values import FloatArray, Group, Homography, Located, NotLocated, Refined, SpanResiduals, VirtualExposure

if TYPE_CHECKING:
    from photonpano.geometry import Camera


class Resampler(Protocol):
    """Chooses the frames that are merged at each level (paper, section 4, "Re-sample")."""

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the groups of a level, in order of their reference instants.

        Args:
            n_frames: frames of the capture.
            level: number of the level, from 1. At level 1 no motion is known yet.

        Raises:
            InputError: the capture is too short for this resampler.
        """


class Trajectory(Protocol):
    """A homography for any instant.

    Convention:
        A homography maps a frame's pixels to the reference plane's pixels and has h33 = 1.
    """

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants (in frames, fractions allowed): (N, 3, 3). Defined for every instant."""


@runtime_checkable
class TurningMotion(Trajectory, Protocol):
    """A trajectory of a camera that only turns: homographies are K R K^-1 of determinant 1, with its matrix K."""

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""


def camera_of_motion(trajectory: Trajectory | None) -> Camera | None:
    """Return the camera of a motion that only turns; None for any other, or where no motion is known."""
    return trajectory.camera if isinstance(trajectory, TurningMotion) else None


class Merger(Protocol):
    """Merges a group into a virtual exposure along the current motion (paper, section 4, "Merge")."""

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge the frames of a group, warped to its reference instant.

        Args:
            source: the capture.
            group: the frames, and the instant whose view they are warped to.
            trajectory: the current motion; None at the first level, where frames are summed without a warp.
            scale: pixels of the exposure per pixel of a frame.
        """


class Locator(Protocol):
    """Estimates the motion between two virtual exposures (paper, section 4, "Locate")."""

    def describe(self, exposure: VirtualExposure) -> Any:
        """Compute the features or pyramids of an exposure, once for all its registrations.

        The framework keeps the result until the last pair of the exposure is registered. Keep it small, without the exposure.
        """

    def register(self, moving: Any, fixed: Any, initial: Homography | None) -> Located | NotLocated:
        """Estimate where `moving` lies in `fixed`. Return `NotLocated` for an image without texture.

        Convention:
            The map takes pixels of `moving` to pixels of `fixed`; points are (x, y), integers are pixel centres. Both images
            are exposures of the same scale, and the map is in their pixels.

        Args:
            moving: what `describe` returned for the moving exposure.
            fixed: what `describe` returned for the fixed exposure.
            initial: (3, 3) map to start from, None while no motion is known.
        """


@runtime_checkable
class KeepsHypotheses(Locator, Protocol):
    """A locator that lists where an exposure may lie, as where a scene repeats.

    At the first level, the framework decides where each registration of such a locator starts: at the motion that short spans
    of frames show, or where they show none, at the hypothesis that continues the motion of the exposures before. Other locators
    get no initial map there.
    """

    def hypotheses(self, moving: Any, fixed: Any) -> Sequence[Homography]:
        """Return motions to start from that are nearly as likely as each other, likeliest first; empty without texture.

        Convention:
            As in `register`: (3, 3) maps, pixels of `moving` to pixels of `fixed`.

        Args:
            moving: what `describe` returned for the moving exposure.
            fixed: what `describe` returned for the fixed exposure.
        """


@runtime_checkable
class LocatesTurns(Locator, Protocol):
    """A locator that can use what is known of a camera that only turns: a pair then has three unknowns, and not eight."""

    def turning(self, camera_matrix: FloatArray) -> Locator:
        """Return this locator for exposures of a camera that only turns.

        The framework asks once a level for the model `rotation`, if the focal length is given, or found by the level before.
        Where a pair of exposures determines eight parameters, the locator should return what it returns without the camera,
        since the focal length is found from such pairs. Elsewhere it may return the motion K R K^-1, with information on the
        three unknowns of the rotation only, as `photonpano.locating.information_on_turn` gives it.

        Args:
            camera_matrix: (3, 3) K, in px of the exposures, which are free of lens distortion.
        """


class Interpolator(Protocol):
    """Turns located instants into a trajectory (paper, section 4, "Interpolate")."""

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> Trajectory:
        """Fit a trajectory.

        Args:
            instants: (N,) float64, increasing, in frames; N is at least 1.
            homographies: (N, 3, 3) float64, frame pixels to reference pixels.
            information: (N, 8, 8) inverse covariances of the parameters p1..p8, None if unknown.
        """


@runtime_checkable
class InterpolatesTurns(Protocol):
    """An interpolator that knows how a camera turns; others get the homographies of small turns instead."""

    def fit_turns(
        self, instants: FloatArray, turns: FloatArray, information: FloatArray | None
    ) -> Callable[[FloatArray], FloatArray]:
        """Fit small turns beyond a path that is known.

        Args:
            instants: (N,) float64, increasing, in frames; N is at least 1.
            turns: (N, 3) rotation vectors in radians, up to about half a radian.
            information: (N, 3, 3) inverse covariances of the turns, None if unknown.

        Returns:
            A function from (M,) instants to (M, 3) turns, defined for every instant.
        """


class PanoramaView(Protocol):
    """The panorama along a motion, as frames of the camera would see it."""

    def predicted(self, instant: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Predict the frame of an instant: its mean count, and the variance of the count.

        Returns:
            Two images, both (H, W) float32, NaN where the panorama was not seen.
        """


class Refiner(Protocol):
    """Corrects the motion after the last level, from what the photons of a few frames show beyond it."""

    def refine(
        self, source: Source, trajectory: Trajectory, std_px: FloatArray, residuals: SpanResiduals, view: PanoramaView
    ) -> Refined | None:
        """Correct the motion, where it differs from what the photons show by more than their noise.

        The framework renders the panorama along the refined motion, measures the residuals again, and calls the refiner again,
        until it finds nothing more, for a certain number of rounds. It does not use a motion that explains the photons worse.

        Args:
            source: the capture.
            trajectory: the motion so far; the homography of the reference frame is the identity.
            std_px: (T,) expected corner error of each frame, in px of a frame; infinite where nothing was located.
            residuals: what short spans of frames show beyond the trajectory.
            view: the panorama along the trajectory.

        Returns:
            None if the photons show nothing to correct.
        """
