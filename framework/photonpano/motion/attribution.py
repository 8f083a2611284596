"""Attribute errors to the plugin that caused them: sources and trajectories whose errors name it, not the caller."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike

from photonpano.errors import PhotonpanoError, PluginError
from photonpano.protocols import Source, Trajectory
from photonpano.source_wrapper import ArrayT, SourceWrapper, capabilities_of, with_capabilities
from photonpano.values import FloatArray, FrameSpan


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


def attributed(source: Source, origin: str) -> AttributedSource:
    """Return a source whose errors name the plugin, whether a merger, the renderer or a preview reads it.

    It has the methods `packed`, `corrected` and `truth` if the source has them.

    Args:
        source: the source.
        origin: who provides it, such as "source 'packed-npy' of photonpano 0.1.0".
    """
    return with_capabilities(AttributedSource, capabilities_of(source))(source, origin)


class AttributedSource(SourceWrapper):
    """A source that names its plugin in errors: made by `attributed`.

    Reading a span raises a `PluginError` if the source failed with an exception that is not for users, or broke its contract.
    """

    def __init__(self, source: Source, origin: str) -> None:
        super().__init__(source)
        self._origin = origin

    def read(self, method: Callable[[FrameSpan], ArrayT], span: FrameSpan, shape: tuple[int, ...]) -> ArrayT:
        """See `SourceWrapper`."""
        try:
            found = method(span)
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
