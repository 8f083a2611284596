from photonpano.testing import MergerConformance
from photonpano_example.hooks import SHORT_EXPOSURE


class TestShortExposure(MergerConformance):
    contribution = SHORT_EXPOSURE
    tolerance_px = 0.25  # a dozen frames are left, and their noise looks like a shift
