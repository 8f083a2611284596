"""Config keys shared by several locators, defined once.

The config of a locator derives from these models, and is passed as `limits` to `motion_from_images` or `motion_from_points`.
Light enough for hook modules.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from photonpano.plugins.contributions import Config

# A standard deviation in px, or `auto`: according to the noise of an exposure.
BlurPx: TypeAlias = Annotated[float, Field(ge=0, le=16)] | Literal["auto"]


class BlurConfig(Config):
    """Blur against photon noise."""

    blur_px: BlurPx = Field(
        "auto",
        description="standard deviation of the Gaussian blur against photon noise, in px; auto is 1, and up to 2.5 in the dark",
    )


class ImageLimits(Config):
    """Thresholds of acceptance for two aligned images."""

    min_overlap: float = Field(0.1, gt=0, le=1, description="least fraction of the image that both exposures must see")
    min_agreement: float = Field(
        0.5,
        ge=0,
        le=1,
        description="a pair is rejected if the correlation of its aligned images, corrected for photon noise, is below this",
    )
    max_std_px: float = Field(
        15.0, gt=0, description="a pair is rejected if its images leave the corners of a frame more uncertain than this"
    )


class PointLimits(Config):
    """Thresholds of acceptance for matched points."""

    threshold_px: float = Field(
        2.0, gt=0, le=50, description="a match is an inlier if it lies within this distance of the motion"
    )
    min_inliers: int = Field(
        12,
        ge=5,
        description="a pair with fewer inliers is rejected; for the rotation of a camera that turns, three eighths of them "
        "suffice",
    )
    max_std_px: float = Field(
        10.0, gt=0, description="a pair is rejected if its matches leave the corners of a frame more uncertain than this"
    )


class MatchingConfig(BlurConfig, PointLimits):
    """How points are matched, and when a motion is accepted."""

    search_px: float = Field(
        12.0,
        gt=0,
        description="from level 2 on, matches are searched within this radius of the position that the current motion predicts",
    )


class KeypointConfig(MatchingConfig):
    """How keypoints are selected and matched, and when a motion is accepted."""

    max_keypoints: int = Field(2000, ge=16, le=100_000, description="number of keypoints kept of an exposure, the strongest")
    ratio: float = Field(
        0.8,
        gt=0,
        le=1,
        description="Lowe's ratio test: a match is kept if its distance is below this fraction of that of the second best",
    )


class PyramidConfig(Config):
    """Size of the image pyramid."""

    pyramid_levels: int = Field(4, ge=1, le=8, description="levels of the image pyramid, each half as large as the one before")


class AlignmentConfig(BlurConfig, ImageLimits):
    """How images are blurred before alignment, and when a motion is accepted."""
