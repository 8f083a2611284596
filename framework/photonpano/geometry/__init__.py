"""Pure functions on homographies and canvases: points are (x, y), integers are pixel centres, maps are float64."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
