"""Attribution of errors: name the plugin that caused an error, not its caller."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike

from photonpano.errors import PhotonpanoError, PluginError, described
from photonpano.interrupts import is_interrupt
from photonpano.protocols.motion import Trajectory
from photonpano.values import FloatArray


class BrokenContract(Exception):  # noqa: N818 - it is not raised to callers
    """What a component returned although its protocol does not allow it, as a clause; raised inside `attributing`."""


def shown(value: object) -> str:
    """Describe a value by its type, and an array by its shape and type."""
    return f"{value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"


@contextmanager
def attributing(origin: str, where: str) -> Iterator[None]:
    """Attribute errors of the block to a component. Errors that are written for users, and interrupts, pass unchanged.

    Args:
        origin: who provides the component, such as "merger 'photon-mle' of photonpano 0.1.0".
        where: what it works on, such as "level 2" or "frames 0 to 15".

    Raises:
        PluginError: the component failed, or broke its contract.
    """
    try:
        yield
    except PhotonpanoError:
        raise
    except BrokenContract as error:
        raise PluginError(f"{origin} broke its contract at {where}: {error}") from None
    except BaseException as error:  # a plugin that calls sys.exit() must not end the program in silence
        if is_interrupt(error):
            raise
        raise PluginError(f"{origin} failed at {where}: {described(error)}") from error


class AttributedTrajectory:
    """A trajectory whose errors name its interpolator, and whose homographies are checked.

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
            PluginError: the trajectory failed, or returned anything but N finite homographies.
        """
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        with attributing(self._origin, f"level {self._level}"):
            found = np.asarray(self._trajectory.at(frame_indices))
            if found.dtype.kind not in "fiu":
                raise BrokenContract(f"homographies are float64, got {shown(found)}")
            if found.shape != (len(frames), 3, 3):
                raise BrokenContract(f"expected homographies of the shape ({len(frames)}, 3, 3), got {found.shape}")
            if (bad := ~np.isfinite(found).all(axis=(1, 2)) | (found[:, 2, 2] == 0)).any():
                first = int(np.argmax(bad))
                raise BrokenContract(
                    f"a homography is finite with h33 = 1, that of frame {frames[first]:g} is {found[first].tolist()}"
                )
            return np.asarray(found, dtype=np.float64)
