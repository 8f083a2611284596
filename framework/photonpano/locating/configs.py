"""What backends are told alike: one name, one bound and one sentence for each key that several of them have.

The config of a backend derives from these, and goes as `limits` to what judges its motions. Light enough for hook modules.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from photonpano.contributions import Config

BlurPx: TypeAlias = Annotated[float, Field(ge=0, le=16)] | Literal["auto"]
"""A standard deviation in px, or `auto`: as much as the noise of an exposure asks for."""


class BlurConfig(Config):
    """How photon noise is quieted before a backend looks at an exposure."""

    blur_px: BlurPx = Field(
        "auto",
        description="standard deviation of the Gaussian that quiets photon noise, in px; "
        "auto takes 1, and up to 2.5 in the dark",
    )


class ImageLimits(Config):
    """What an alignment of two images must fulfil to be believed."""

    min_overlap: float = Field(0.1, gt=0, le=1, description="the least share of the image that both exposures must see")
    min_agreement: float = Field(
        0.5,
        ge=0,
        le=1,
        description="a pair whose images, with photon noise taken out, correlate less than this after alignment is not located",
    )
    max_std_px: float = Field(
        15.0, gt=0, description="a pair whose images tell less well than this where the corners of the frame lie is not located"
    )


class PointLimits(Config):
    """What matched points must fulfil to be believed."""

    threshold_px: float = Field(2.0, gt=0, le=50, description="a match that fits better than this can be an inlier, in px")
    min_inliers: int = Field(12, ge=5, description="a pair with fewer inliers is not located")
    max_std_px: float = Field(
        10.0, gt=0, description="a pair whose matches pin the corners of the frame down less well than this is not located"
    )


class MatchingConfig(BlurConfig, PointLimits):
    """How points are matched, and when their matches are believed."""

    search_px: float = Field(
        12.0, gt=0, description="from the second level on, matches are looked for so far from where the motion known puts them"
    )


class KeypointConfig(MatchingConfig):
    """How keypoints are chosen and matched, and when their matches are believed."""

    max_keypoints: int = Field(2000, ge=16, le=100_000, description="the strongest keypoints of an exposure that are kept")
    ratio: float = Field(0.8, gt=0, le=1, description="a match must be so many times nearer than the second best (Lowe 2004)")


class PyramidConfig(Config):
    """How far an alignment begins from the finest image."""

    pyramid_levels: int = Field(4, ge=1, le=8, description="levels of the pyramid, each half as large as the one before")


class AlignmentConfig(BlurConfig, ImageLimits):
    """How exposures are aligned by their brightness, and when they are believed to show the same."""
