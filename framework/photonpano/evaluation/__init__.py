"""Scores of trajectories and panoramas against the truth of simulated captures.

A name is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
