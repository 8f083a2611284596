"""The interfaces of sources: what every source gives, and the optional methods that some give besides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, Frames, FrameSpan, Light, Response, StreamInfo

if TYPE_CHECKING:
    from photonpano.geometry import Camera


class Source(Protocol):
    """A capture that is open. Every method may be called from several threads at once."""

    @property
    def info(self) -> StreamInfo:
        """Frames, size, rate."""

    @property
    def response(self) -> Response:
        """How flux becomes counts."""

    @property
    def valid(self) -> BoolArray:
        """(H, W) mask, False for pixels that must not be used (hot, dead, behind a colour filter)."""

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""

    def close(self) -> None:
        """Release files; the source is not used afterwards."""

    def __enter__(self) -> Source: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


class Closing:
    """Closes itself at the end of a `with` block: a base class of sources."""

    def close(self) -> None:
        """Release files; by default there are none."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """What is there of a capture that is still being written."""

    source: Source | None  # the whole frames that are there; None as long as there is none
    promised: int | None = None  # frames that the capture will have, if it says so


@dataclass(frozen=True, slots=True)
class Piped:
    """A capture that arrives on standard input. Written to a file as it comes, it is one of the same source."""

    header_bytes: int  # what comes before the first frame
    frame_bytes: int  # bytes of a frame


@runtime_checkable
class PackedSource(Source, Protocol):
    """Gives packed frames, so that copying and summing need no unpacking."""

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte.

        Returns:
            (n, H, ceil(W / 8)), as `numpy.packbits` packs along the width: the first pixel is the highest bit, and unused bits
            of the last byte of a row are zero. The caller may write to it.
        """


@runtime_checkable
class ColouredSource(Source, Protocol):
    """A source in colour. By itself it is grey, for the motion; the panorama is rendered from the sources of its colours.

    Behind a colour filter array, each pixel has one colour, and corrected sums are those of pixels of one colour. In binary
    frames of several channels, all pixels are valid in all of them, and a pixel of the grey source is lit where it is in any.
    """

    def colours(self) -> Mapping[str, Source]:
        """Return a source for each colour: its frames, in which only pixels that see this colour are valid.

        Returns:
            Sources of "red", "green", "blue", and if there are pixels without filter, "clear", in this order.
        """

    def clear_mix(self) -> FloatArray:
        """Return the flux of a clear pixel, as factors of the flux of red, green and blue ones, whose sum it is: (3,)."""


def light_of(source: Source) -> Light | None:
    """Return the changing light of a capture; None if it is steady, or not known."""
    return getattr(source, "light", None)


def camera_of(source: Source) -> Camera | None:
    """Return the camera of a capture; None if it is not known."""
    return getattr(source, "camera", None)


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
