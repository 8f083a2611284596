"""photonpano: sharp panoramas from single-photon cameras.

These names are public, and so are those of `photonpano.geometry`, `photonpano.photometry`, `photonpano.merging`,
`photonpano.locating`, `photonpano.reading` and `photonpano.compiling`. Plugins and notebooks import nothing else.
A name is imported when it is first used, so that the help of the command line needs no numpy.
"""

from importlib.metadata import entry_points

import lazy_loader

__version__ = "0.2.0"
_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_REMOVED = ("LensedSource", "LinearlyCorrectedSource", "LitSource", "WeightedSource")  # until 0.2


def __getattr__(name: str) -> object:
    if name in _REMOVED:
        raise ImportError(
            f"photonpano.{name} was removed after 0.2: a component reads `corrects_sums`, `weight`, `light` and `camera` "
            "of the `photonpano.Capture` that it gets"
        )
    try:
        return _public(name)
    except AttributeError:
        for command in entry_points(group="photonpano.commands", name=name):  # of a plugin
            return getattr(command.load(), name)
        raise
