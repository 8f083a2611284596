"""The conformance kit: the contract of each kind of component, as test classes for authors of plugins to subclass.

    from photonpano.testing import LocatorConformance

    class TestMine(LocatorConformance):
        contribution = MINE
        config = {"min_inliers": 20}
        tolerance_px = 0.5

The scenes, motions and captures of the checks are public, too. The package needs pytest (`pip install "photonpano[testing]"`);
only tests import it. Names are imported on first use, so that pytest starts as fast as without the kit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
