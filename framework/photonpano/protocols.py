"""What a plugin builds: the interfaces of the five components, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from photonpano.values import (
        BoolArray,
        Counts,
        FloatArray,
        FluxImage,
        Frames,
        FrameSpan,
        Group,
        Homography,
        Located,
        NotLocated,
        Response,
        StreamInfo,
        VirtualExposure,
    )


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
        """(H, W) mask, False for pixels that must not be used (hot, dead, under a filter)."""
        ...

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        ...

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        ...

    def close(self) -> None:
        """Let go of files; the source is not used afterwards."""
        ...

    def __enter__(self) -> Source: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


@runtime_checkable
class PackedSource(Source, Protocol):
    """A source of binary frames that has them packed: what only moves or counts bits need not unpack them."""

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte.

        Returns:
            (n, H, ceil(W / 8)), as `numpy.packbits` packs along the width: the first pixel is the highest bit, and what fills
            up the last byte of a row is zero. It belongs to the caller.
        """
        ...


@runtime_checkable
class LinearlyCorrectedSource(Source, Protocol):
    """A source whose sums hold more than the flux, such as dark counts, and which knows how to take it out."""

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Return what the sum of some frames would be, on average, if they showed nothing but the flux.

        Mergers do this to the sums of frames before they warp them. It is linear, so that the average is right, and may be
        negative.

        Args:
            counts: (H, W), from `counts`.
            n_frames: how many frames they are of.

        Returns:
            (H, W) float32.
        """
        ...


@runtime_checkable
class KnowsTruth(Protocol):
    """A source that knows what it shows, as simulators do: a `Source` with one method more.

    `photonpano simulate` stores the truth as an .npz archive, for `photonpano evaluate`.
    """

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return named arrays; others than these may be among them.

        Convention:
            Homographies map pixels of a frame to pixels of the scene; points are (x, y), integers are pixel centres.

        Returns:
            `homographies` (T, 3, 3) float64, one for each frame, h33 = 1; `scene` (Hs, Ws) float32, the flux that is detected,
            in photons per pixel per frame, without dark counts; `frame_shape` (2,), height and width of a frame.
        """
        ...


class Resampler(Protocol):
    """Chooses which frames are merged at each level (paper, section 4, "Re-sample")."""

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the groups of a level, in order of their reference instants.

        Args:
            n_frames: frames of the capture.
            level: from 1. At level 1 no motion is known yet.

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


class Merger(Protocol):
    """Merges a group into a virtual exposure along the motion known so far (paper, section 4, "Merge")."""

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge the frames of a group, warped to its reference instant.

        Args:
            source: the capture.
            group: which frames, and the instant they are seen from.
            trajectory: the motion known so far; None at the first level, where frames are summed as they are.
            scale: pixels of the exposure per pixel of a frame.
        """
        ...


class Locator(Protocol):
    """Finds the motion between two virtual exposures (paper, section 4, "Locate")."""

    def describe(self, exposure: VirtualExposure) -> Any:
        """Compute once, for one exposure, what every registration of it needs (features, pyramids).

        The framework keeps the result as long as pairs of the exposure are due; keep it small, and without the exposure.
        """
        ...

    def register(self, moving: Any, fixed: Any, initial: Homography | None) -> Located | NotLocated:
        """Estimate where `moving` lies in `fixed`. Never raises for an image without texture.

        Convention:
            The map takes pixels of `moving` to pixels of `fixed`; points are (x, y), integers are pixel centres. Both images
            are exposures of the same scale, and the map is in their pixels.

        Args:
            moving: what `describe` returned for the moving exposure.
            fixed: what `describe` returned for the fixed exposure.
            initial: (3, 3) map to start from, None while no motion is known.
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
