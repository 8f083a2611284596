"""Load what all runs of a batch need. Only the process that runs are forked from imports this module."""

from __future__ import annotations

import importlib
import os
import signal
import sys

_HEAVY = (
    "photonpano.api.batching.running",
    "matplotlib.figure",
    "matplotlib.backends.backend_svg",
    "scipy.optimize",
    "skimage.metrics",
)

for each in (signal.SIGINT, signal.SIGHUP):  # a terminal sends them to all processes; the batch decides what ends
    signal.signal(each, signal.SIG_IGN)
os.environ.pop("PYTHONSAFEPATH", None)
if sys.platform != "darwin":  # where libraries of the system do not survive a fork once they are loaded
    for name in _HEAVY:
        importlib.import_module(name)

    import numpy as np

    from photonpano.photometry import packed_counts

    packed_counts(np.zeros((8, 1, 1), np.uint8), 8)  # the machinery of compiled loops
