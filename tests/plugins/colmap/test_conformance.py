"""The components of this plugin keep what every one of their kind promises."""

from __future__ import annotations

from photonpano import discover
from photonpano.testing import LocatorConformance, PoseEstimatorConformance

CATALOG = discover()


class TestPycolmapTwoView(LocatorConformance):
    contribution = CATALOG.find("locator", "pycolmap-two-view").contribution
    tolerance_px = 0.3


class TestColmapAverages(PoseEstimatorConformance):
    contribution = CATALOG.find("pose-estimator", "colmap-averages").contribution
    config = {"group_size": 20}


class TestStratifiedPose(PoseEstimatorConformance):
    contribution = CATALOG.find("pose-estimator", "stratified-pose").contribution
    config = {"group_size": 20, "levels": 2}
    tolerance = 0.01
    tolerance_deg = 0.5
