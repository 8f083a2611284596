"""The conformance kit: what a plugin promises, as tests that its author subclasses.

A class for each kind of component, for pytest:

    from photonpano.testing import LocatorConformance

    class TestMine(LocatorConformance):
        contribution = MINE
        config = {"min_inliers": 20}
        tolerance_px = 0.5

Beside them stand the scenes, motions and captures that the checks use, for tests of one's own. Tests import this package, and
nothing else does: it needs pytest (`pip install "photonpano[testing]"`). Each name is imported when it is first used, so that
pytest starts as fast as without it.
"""

from typing import TYPE_CHECKING

from photonpano.lazy import imported_on_use

if TYPE_CHECKING:
    from photonpano.testing.captures import KnownMotion, MemorySource, photographed, recorded
    from photonpano.testing.interpolators import InterpolatorConformance
    from photonpano.testing.locators import LocatorConformance
    from photonpano.testing.mergers import MergerConformance
    from photonpano.testing.resamplers import ResamplerConformance
    from photonpano.testing.scenes import Scene
    from photonpano.testing.sources import SourceConformance

__all__ = [
    "InterpolatorConformance",
    "KnownMotion",
    "LocatorConformance",
    "MemorySource",
    "MergerConformance",
    "ResamplerConformance",
    "Scene",
    "SourceConformance",
    "photographed",
    "recorded",
]

_MODULES = ("scenes", "captures", "sources", "resamplers", "mergers", "locators", "interpolators")
"""Where the public names are defined."""

if not TYPE_CHECKING:  # type checkers see the imports, and so know which names there are
    __getattr__, __dir__ = imported_on_use(__name__, __all__, _MODULES)
