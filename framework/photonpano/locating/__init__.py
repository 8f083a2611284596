"""What locators of any backend share: configs, views of an exposure, least-squares fits, and how a motion is judged in the end.

Each name is imported when it is first used: hook modules take configs from here, and need neither OpenCV nor scipy for them.
"""

from typing import TYPE_CHECKING

from photonpano.lazy import imported_on_use

if TYPE_CHECKING:
    from photonpano.locating.configs import (
        AlignmentConfig,
        BlurConfig,
        BlurPx,
        ImageLimits,
        KeypointConfig,
        MatchingConfig,
        PointLimits,
        PyramidConfig,
    )
    from photonpano.locating.fitting import MIN_NOISE_PX, Fit, fit_homography
    from photonpano.locating.images import motion_from_images
    from photonpano.locating.points import least_agreeing, motion_from_points
    from photonpano.locating.viewing import View, blur_against_noise, stabilised_8_bit, view_of, view_pyramid

__all__ = [
    "MIN_NOISE_PX",
    "AlignmentConfig",
    "BlurConfig",
    "BlurPx",
    "Fit",
    "ImageLimits",
    "KeypointConfig",
    "MatchingConfig",
    "PointLimits",
    "PyramidConfig",
    "View",
    "blur_against_noise",
    "fit_homography",
    "least_agreeing",
    "motion_from_images",
    "motion_from_points",
    "stabilised_8_bit",
    "view_of",
    "view_pyramid",
]

if not TYPE_CHECKING:  # type checkers see the imports, and so know which names there are
    __getattr__, __dir__ = imported_on_use(__name__, __all__, ("configs", "fitting", "images", "points", "viewing"))
