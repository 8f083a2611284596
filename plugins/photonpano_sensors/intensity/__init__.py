"""Captures of conventional high-speed cameras: grey levels instead of single photons."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
