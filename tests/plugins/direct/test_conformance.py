"""Conformance of the locator."""

from __future__ import annotations

from photonpano import discover
from photonpano.testing import LocatorConformance

CATALOG = discover()


class TestDirect(LocatorConformance):
    contribution = CATALOG.find("locator", "direct").contribution
    tolerance_px = 0.1
