"""The locator of this plugin keeps what every locator promises."""

from __future__ import annotations

from photonpano import discover
from photonpano.testing import LocatorConformance

CATALOG = discover()


class TestDirect(LocatorConformance):
    contribution = CATALOG.find("locator", "direct").contribution
    tolerance_px = 0.1
