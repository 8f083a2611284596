"""Parts of locators: configs, views of an exposure, coarse-to-fine alignment, least-squares fits, and acceptance of a motion.

A name is imported when it is first used, so that hook modules can take configs from here without OpenCV and scipy.
"""

from typing import TYPE_CHECKING

from photonpano.lazy import imported_on_use

if TYPE_CHECKING:
    from photonpano.locating.alignment import (
        ALL_PARAMETERS,
        MIN_COMMON_CURVATURE,
        NO_TEXTURE,
        NOTHING_SEEN,
        PRIOR_STD,
        SMALLEST_SIDE,
        TRANSLATION,
        coarse_to_fine,
        free_parameters,
    )
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
    from photonpano.locating.phase import shift_between, shift_by_phase
    from photonpano.locating.points import Matches, consensus_of, motion_from_points, too_few_matches
    from photonpano.locating.viewing import View, blur_against_noise, stabilised_8_bit, view_of, view_pyramid

__all__ = [
    "ALL_PARAMETERS",
    "MIN_COMMON_CURVATURE",
    "MIN_NOISE_PX",
    "NOTHING_SEEN",
    "NO_TEXTURE",
    "PRIOR_STD",
    "SMALLEST_SIDE",
    "TRANSLATION",
    "AlignmentConfig",
    "BlurConfig",
    "BlurPx",
    "Fit",
    "ImageLimits",
    "KeypointConfig",
    "Matches",
    "MatchingConfig",
    "PointLimits",
    "PyramidConfig",
    "View",
    "blur_against_noise",
    "coarse_to_fine",
    "consensus_of",
    "fit_homography",
    "free_parameters",
    "motion_from_images",
    "motion_from_points",
    "shift_between",
    "shift_by_phase",
    "stabilised_8_bit",
    "too_few_matches",
    "view_of",
    "view_pyramid",
]

if not TYPE_CHECKING:  # type checkers see the imports, and so know which names there are
    __getattr__, __dir__ = imported_on_use(
        __name__, __all__, ("configs", "viewing", "points", "fitting", "alignment", "phase", "images")
    )
