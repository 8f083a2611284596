"""What locators of any backend share: views of an exposure, least-squares fits, and how a motion is judged in the end."""

from photonpano.locating.fitting import MIN_NOISE_PX, Fit, fit_homography
from photonpano.locating.images import ImageLimits, motion_from_images
from photonpano.locating.points import PointLimits, least_agreeing, motion_from_points
from photonpano.locating.viewing import View, blur_against_noise, stabilised_8_bit, view_of

__all__ = [
    "MIN_NOISE_PX",
    "Fit",
    "ImageLimits",
    "PointLimits",
    "View",
    "blur_against_noise",
    "fit_homography",
    "least_agreeing",
    "motion_from_images",
    "motion_from_points",
    "stabilised_8_bit",
    "view_of",
]
