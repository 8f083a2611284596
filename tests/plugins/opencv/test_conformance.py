"""Conformance of the locators."""

from __future__ import annotations

from photonpano import discover
from photonpano.testing import LocatorConformance

CATALOG = discover()


class TestOpencvSift(LocatorConformance):
    contribution = CATALOG.find("locator", "opencv-sift").contribution
    tolerance_px = 0.3


class TestOpencvEcc(LocatorConformance):
    contribution = CATALOG.find("locator", "opencv-ecc").contribution
    tolerance_px = 0.1


class TestOpencvOrb(LocatorConformance):
    contribution = CATALOG.find("locator", "opencv-orb").contribution
    tolerance_px = 0.8


class TestPhaseCorrelation(LocatorConformance):
    contribution = CATALOG.find("locator", "phase-correlation").contribution
    tolerance_px = 0.1
    motions = ("sub-pixel shift", "shift")
    free = (4, 5)
