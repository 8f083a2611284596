"""Poses of a camera that travels through a scene: a kind of run, the contract of pose estimators, files of other programs.

A name is imported when it is first used, so that hooks import no heavy library.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
