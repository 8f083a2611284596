"""Attribute errors to the plugin that caused them: sources and trajectories whose errors name it, not the caller."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.errors import PhotonpanoError, PluginError
from photonpano.protocols import LinearlyCorrectedSource, PackedSource, Source, Trajectory
from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, Frames, FrameSpan, Response, StreamInfo

ArrayT = TypeVar("ArrayT", bound="NDArray[Any]")


@contextmanager
def attributing(origin: str, level: int) -> Iterator[None]:
    """Name a component in what it raises by mistake.

    Args:
        origin: who provides it, such as "merger 'photon-mle' of photonpano 0.1.0".
        level: the number of the level that it works for.

    Raises:
        PluginError: the block raised something that was not made for users.
    """
    try:
        yield
    except PhotonpanoError:
        raise
    except Exception as error:
        raise PluginError(f"{origin} failed at level {level}: {type(error).__name__}: {error}") from error


class AttributedSource:
    """A source that is named in what it raises by mistake, whoever reads it: a merger, the renderer, a look at the capture.

    It has `packed` and `corrected` if the source has them.

    Args:
        source: the source.
        origin: who provides it, such as "source 'packed-npy' of photonpano 0.1.0".
    """

    packed: Callable[[FrameSpan], NDArray[np.uint8]]
    corrected: Callable[[Counts, int], FluxImage]

    def __init__(self, source: Source, origin: str) -> None:
        self._source = source
        self._origin = origin
        if isinstance(source, PackedSource):
            self.packed = lambda span: self._packed(source, span)
        if isinstance(source, LinearlyCorrectedSource):
            self.corrected = source.corrected

    @property
    def info(self) -> StreamInfo:
        """Frames, size, rate."""
        return self._source.info

    @property
    def response(self) -> Response:
        """How flux becomes counts."""
        return self._source.response

    @property
    def valid(self) -> BoolArray:
        """(H, W) mask."""
        return self._source.valid

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span.

        Raises:
            PluginError: the source failed in its own way, or broke its contract.
        """
        return self._checked(self._source.counts, span, self.info.frame_shape)

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span.

        Raises:
            PluginError: the source failed in its own way, or broke its contract.
        """
        return self._checked(self._source.frames, span, (len(span), *self.info.frame_shape))

    def close(self) -> None:
        """Let go of files."""
        self._source.close()

    def __enter__(self) -> AttributedSource:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _packed(self, source: PackedSource, span: FrameSpan) -> NDArray[np.uint8]:
        height, width = self.info.frame_shape
        return self._checked(source.packed, span, (len(span), height, -(-width // 8)))

    def _checked(self, read: Callable[[FrameSpan], ArrayT], span: FrameSpan, shape: tuple[int, ...]) -> ArrayT:
        try:
            found = read(span)
        except PhotonpanoError:
            raise
        except Exception as error:
            raise PluginError(f"{self._origin} failed at {span}: {type(error).__name__}: {error}") from error
        if np.shape(found) != shape:
            raise PluginError(f"{self._origin} broke its contract at {span}: expected the shape {shape}, got {np.shape(found)}")
        return found


class AttributedTrajectory:
    """A trajectory whose interpolator is named in its errors, and which is checked to give a homography for every instant.

    Args:
        trajectory: what the interpolator fitted.
        origin: who provides the interpolator, such as "interpolator 'geodesic' of photonpano 0.1.0".
        level: the number of the level that it was fitted at.
    """

    def __init__(self, trajectory: Trajectory, origin: str, level: int) -> None:
        self._trajectory = trajectory
        self._origin = origin
        self._level = level

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3).

        Raises:
            PluginError: the trajectory failed in its own way, or gave something else.
        """
        with attributing(self._origin, self._level):
            found = np.asarray(self._trajectory.at(frame_indices), dtype=np.float64)
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        problem = None
        if found.shape != (len(frames), 3, 3):
            problem = f"expected homographies of the shape ({len(frames)}, 3, 3), got {found.shape}"
        elif (bad := ~np.isfinite(found).all(axis=(1, 2)) | (found[:, 2, 2] == 0)).any():
            first = int(np.argmax(bad))
            problem = f"a homography is finite with h33 = 1, that of frame {frames[first]:g} is {found[first].tolist()}"
        if problem:
            raise PluginError(f"{self._origin} broke its contract at level {self._level}: {problem}")
        return found
