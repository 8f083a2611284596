"""The interfaces of the components that plugins build."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.context import Progress
from photonpano.values import (
    BoolArray,
    CameraGuess,
    Counts,
    FloatArray,
    FluxImage,
    Frames,
    FrameSpan,
    Group,
    Homography,
    Light,
    Located,
    NotLocated,
    Panorama,
    PanoramaRows,
    PoseEstimate,
    Refined,
    Response,
    SpanResiduals,
    StreamInfo,
    VirtualExposure,
)

if TYPE_CHECKING:
    from photonpano.geometry import Camera, Canvas


class Source(Protocol):
    """A capture that is open. Every method may be called from several threads at once."""

    @property
    def info(self) -> StreamInfo:
        """Frames, size, rate."""
        ...

    @property
    def response(self) -> Response:
        """How flux becomes counts."""
        ...

    @property
    def valid(self) -> BoolArray:
        """(H, W) mask, False for pixels that must not be used (hot, dead, behind a colour filter)."""
        ...

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        ...

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        ...

    def close(self) -> None:
        """Release files; the source is not used afterwards."""
        ...

    def __enter__(self) -> Source: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


@runtime_checkable
class PackedSource(Source, Protocol):
    """Gives packed frames, so that copying and summing need no unpacking."""

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte.

        Returns:
            (n, H, ceil(W / 8)), as `numpy.packbits` packs along the width: the first pixel is the highest bit, and unused bits
            of the last byte of a row are zero. The caller may write to it.
        """
        ...


@runtime_checkable
class LinearlyCorrectedSource(Source, Protocol):
    """A source whose sums contain more than the flux, such as dark counts, and that can subtract it."""

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Correct a sum of frames, so that on average it is the sum of frames of the flux alone.

        Mergers correct sums of frames before they warp them. The correction is linear, so that the average is right; the result
        may be negative.

        Args:
            counts: (H, W), from `counts`.
            n_frames: number of frames in the sum.

        Returns:
            (H, W) float32.
        """
        ...


@runtime_checkable
class WeightedSource(Source, Protocol):
    """A source whose pixels carry different amounts of information, as those behind filters of different colours do."""

    def weights(self) -> FluxImage:
        """Return how many frames of the best pixel a frame of each pixel is worth: (H, W) float32, from 0 to 1.

        Mergers weight the (corrected) counts of a pixel with it, and the number of frames in which it was seen.
        """
        ...


@runtime_checkable
class ColouredSource(Source, Protocol):
    """A source behind a colour filter array. By itself it is grey: its corrected sums are those of pixels of one colour.

    Motion is estimated from this grey source, and the panorama is rendered from the sources of its colours.
    """

    def colours(self) -> Mapping[str, Source]:
        """Return a source for each colour: the same frames, in which only the pixels behind filters of this colour are valid.

        Returns:
            Sources of "red", "green", "blue", and if there are pixels without filter, "clear", in this order.
        """
        ...

    def clear_mix(self) -> FloatArray:
        """Return the flux of a clear pixel, as factors of the flux of red, green and blue ones, whose sum it is: (3,)."""
        ...


@runtime_checkable
class LitSource(Source, Protocol):
    """A source in changing light, which is known.

    What is summed over frames counts each frame by its gain; what predicts a frame multiplies the flux by it. A source in
    steady light does not have it.
    """

    @property
    def light(self) -> Light:
        """The gain of each frame."""
        ...


def light_of(source: Source) -> Light | None:
    """Return the changing light of a capture; None if it is steady, or not known."""
    return source.light if isinstance(source, LitSource) else None


@runtime_checkable
class LensedSource(Source, Protocol):
    """A source whose camera is known.

    Frames are warped through its lens: homographies then map ideal pixels, those without distortion, to ideal pixels.
    """

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        ...


def camera_of(source: Source) -> Camera | None:
    """Return the camera of a capture; None if it is not known."""
    return source.camera if isinstance(source, LensedSource) else None


@runtime_checkable
class KnowsTruth(Protocol):
    """A source with ground truth, such as a simulator: a `Source` with one more method.

    `photonpano simulate` stores the truth as an .npz archive, for `photonpano evaluate`.
    """

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return the ground truth as named arrays; there may be more than the following ones.

        Convention:
            Homographies map pixels of a frame to pixels of the scene; points are (x, y), integers are pixel centres. Directions
            are x right, y down, z ahead.

        Returns:
            `homographies` (T, 3, 3) float64, one for each frame, h33 = 1; `scene` (Hs, Ws) float32, the flux that is detected,
            in photons per pixel per frame, without dark counts, or (Hs, Ws, 3) of red, green and blue pixels; `frame_shape`
            (2,), height and width of a frame. If the camera only turned, also `rotations` (T, 3, 3), directions of a frame to
            those of one camera, and `camera_matrix` (3, 3). If `scene_projection` is "spherical", the scene is an
            equirectangular panorama, 360 degrees wide, whose middle that camera looks at; homographies are then K R K^-1 with
            determinant 1. If the camera travelled through a scene with depth, there are no homographies but
            `camera_from_world` (T, 3, 4), which maps points of the world to points of the camera, X_c = R X_w + t, and
            `camera_matrix`.
        """
        ...


@runtime_checkable
class KnowsSharpViews(KnowsTruth, Protocol):
    """A source that can return its frames without noise, such as a simulator.

    `photonpano simulate --sharp-every` stores them as pictures.
    """

    def sharp_view(self, frame: int) -> FluxImage:
        """Return the flux of a frame of the capture: (H, W) float32, photons that are detected per pixel per frame.

        There are no dark counts in it, and no differences between pixels.

        Raises:
            InputError: there is no such frame.
        """
        ...


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
        ...


class Trajectory(Protocol):
    """A homography for any instant.

    Convention:
        A homography maps a frame's pixels to the reference plane's pixels and has h33 = 1.
    """

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants (in frames, fractions allowed): (N, 3, 3). Defined for every instant."""
        ...


@runtime_checkable
class TurningMotion(Trajectory, Protocol):
    """A trajectory of a camera that only turns: homographies are K R K^-1 of determinant 1, with its matrix K."""

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        ...


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
        ...


class Locator(Protocol):
    """Estimates the motion between two virtual exposures (paper, section 4, "Locate")."""

    def describe(self, exposure: VirtualExposure) -> Any:
        """Compute the features or pyramids of an exposure, once for all its registrations.

        The framework keeps the result until the last pair of the exposure is registered. Keep it small, without the exposure.
        """
        ...

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
        ...


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
        ...


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
        ...


class Interpolator(Protocol):
    """Turns located instants into a trajectory (paper, section 4, "Interpolate")."""

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> Trajectory:
        """Fit a trajectory.

        Args:
            instants: (N,) float64, increasing, in frames; N is at least 1.
            homographies: (N, 3, 3) float64, frame pixels to reference pixels.
            information: (N, 8, 8) inverse covariances of the parameters p1..p8, None if unknown.
        """
        ...


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
        ...


class PanoramaView(Protocol):
    """The panorama along a motion, as frames of the camera would see it."""

    def predicted(self, instant: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Predict the frame of an instant: its mean count, and the variance of the count.

        Returns:
            Two images, both (H, W) float32, NaN where the panorama was not seen.
        """
        ...


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
        ...


class Renderer(Protocol):
    """Renders the panorama: flux and weight on a canvas, from the frames and their motion."""

    def render(
        self,
        source: Source,
        trajectory: Trajectory,
        span: FrameSpan,
        canvas: Canvas,
        tolerance_px: float,
        advance: Callable[[int], None],
    ) -> Panorama:
        """Render the frames of a span on a canvas.

        The framework chooses the canvas. One that exceeds the memory of the run is rendered in tiles, each with a call; what a
        pixel shows should not depend on the tile that it lies in.

        Convention:
            Points are (x, y), integers are pixel centres. A pixel p of frame t is at `canvas.transform @ trajectory.at(t) @ p`
            on a planar canvas, and on others at `canvas.pixels(canvas.plane_to_rays @ trajectory.at(t) @ p)`.
            p is an ideal pixel where the lens is known. A contribution without `renders_on_any_canvas` gets planar canvases,
            and no lens.

        Args:
            source: the capture. Pixels outside of its mask are left out; sums of a `LinearlyCorrectedSource` are corrected.
            trajectory: frame pixels to reference pixels.
            span: the frames to render.
            canvas: the pixel grid.
            tolerance_px: motion, in px of a frame, within which frames may be summed before they are warped.
            advance: called with the number of frames that are done; over the whole call these add up to the frames of the span.

        Returns:
            Flux in photons per pixel of a frame per frame, whatever the scale of the canvas, and its weight, with
            `canvas.transform` as canvas. Flux is NaN exactly where the weight is 0.
        """
        ...


class FinishedPanorama(Protocol):
    """A panorama that is rendered and stored. It may exceed the memory, so it is read in rows."""

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        ...

    @property
    def in_colour(self) -> bool:
        """Whether pixels have red, green and blue."""
        ...

    @property
    def canvas(self) -> Homography:
        """(3, 3), pixels of the reference plane to pixels of the panorama."""
        ...

    @property
    def white_flux(self) -> float:
        """Flux that is white in panorama.png, photons per pixel per frame."""
        ...

    def rows(self, start: int, stop: int) -> PanoramaRows:
        """Return flux, weight, standard deviation and saturated pixels of the rows from `start` to `stop - 1`."""
        ...


class Exporter(Protocol):
    """Writes the panorama as a file of another format."""

    def export(self, panorama: FinishedPanorama, path: Path) -> None:
        """Write one file, and nothing else.

        The framework puts it into the run folder with the other results, and records its hash.

        Args:
            panorama: what to write.
            path: the file; it does not exist yet.
        """
        ...


class PoseEstimator(Protocol):
    """Estimates where a camera was in each frame, in six degrees of freedom (paper, section 6). Experimental."""

    def estimate(self, source: Source, camera: CameraGuess, progress: Progress) -> PoseEstimate:
        """Estimate the poses of a capture.

        The framework refuses an estimate with poses for frames that are not located, or without poses for those that are.

        Args:
            source: the capture.
            camera: what the spec says about it; what it gives stays as it is.
            progress: receives stages and messages.

        Raises:
            LocationError: there are no poses to be found; the message says why, with numbers, and what to do.
        """
        ...
