"""The components of one level of the loop, built and ready to run."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass

from photonpano.motion.attribution import attributing
from photonpano.protocols import Interpolator, Locator, Merger, Resampler


@dataclass(frozen=True, slots=True)
class NamedLocator:
    """A locator of a level.

    Attributes:
        name: as in the spec; the second of a level with the same name is numbered, such as "opencv-sift 2".
        component: the locator.
        origin: who provides it, such as "locator 'opencv-sift' of photonpano 0.1.0".
    """

    name: str
    component: Locator
    origin: str


@dataclass(frozen=True, slots=True)
class Level:
    """The components of one level, built.

    Attributes:
        number: from 1.
        scale: pixels of the level's exposures per pixel of a frame.
        locators: at least one; a pair that one of them loses is offered to the next.
        origins: who provides each of the other components, by its kind, such as "merger 'photon-mle' of photonpano 0.1.0".
    """

    number: int
    scale: float
    resampler: Resampler
    merger: Merger
    locators: tuple[NamedLocator, ...]
    interpolator: Interpolator
    origins: Mapping[str, str]

    def attributing(self, component: str | NamedLocator) -> AbstractContextManager[None]:
        """Name a component, given as its kind (such as "merger") or as a locator, in what it raises by mistake.

        Raises:
            PluginError: the block raised something that was not made for users.
        """
        origin = self.origins[component] if isinstance(component, str) else component.origin
        return attributing(origin, self.number)
