"""The conformance kit: the contract of each kind of component, as test classes for authors of plugins to subclass.

    from photonpano.testing import LocatorConformance

    class TestMine(LocatorConformance):
        contribution = MINE
        config = {"min_inliers": 20}
        tolerance_px = 0.5

The scenes, motions and captures of the checks are public, too. The package needs pytest (`pip install "photonpano[testing]"`);
only tests import it. Names are imported on first use, so that pytest starts as fast as without the kit.
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

if not TYPE_CHECKING:  # type checkers see the imports above
    __getattr__, __dir__ = imported_on_use(__name__, __all__, _MODULES)
