"""Attribution of errors: name the plugin that caused an error, not its caller."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike

from photonpano.contracts.loop import HOMOGRAPHIES
from photonpano.contracts.rules import BrokenContract
from photonpano.errors import PhotonpanoError, PluginError, described
from photonpano.interrupts import is_interrupt
from photonpano.protocols import Trajectory
from photonpano.values import FloatArray


@contextmanager
def attributing(origin: str, where: str) -> Iterator[None]:
    """Raise a `PluginError` that names a component for errors of the block.

    Errors that are written for users, and interrupts, pass unchanged.

    Args:
        origin: who provides the component, such as "merger 'photon-mle' of photonpano 0.1.0".
        where: what it works on, such as "level 2" or "frames 0 to 15".
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
    """A trajectory fitted at a level, whose errors name its interpolator, and whose homographies are checked."""

    def __init__(self, trajectory: Trajectory, origin: str, level: int) -> None:
        self._trajectory = trajectory
        self._origin = origin
        self._level = level

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants, (N, 3, 3), or raise a `PluginError`."""
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        with attributing(self._origin, f"level {self._level}"):
            found = HOMOGRAPHIES.require(np.asarray(self._trajectory.at(frame_indices)), frames)
            return np.asarray(found, dtype=np.float64)
