"""The baselines keep what their kinds promise."""

from __future__ import annotations

import photonpano_baselines
from photonpano.testing import InterpolatorConformance, MergerConformance

CATALOG = photonpano_baselines.catalog()


class TestBurst(MergerConformance):
    """It finds the motion by itself, as well as patches of 40x56 px allow."""

    contribution = CATALOG.find("merger", "burst").contribution
    compensates = False


class TestLie(InterpolatorConformance):
    contribution = CATALOG.find("interpolator", "lie").contribution
