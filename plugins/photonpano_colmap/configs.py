"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from photonpano import Config


class PycolmapTwoViewConfig(Config):
    """COLMAP's features and matches, LO-RANSAC, least squares."""

    max_keypoints: int = Field(
        2000,
        ge=16,
        le=32_768,
        description="the largest keypoints of an exposure that are kept; matching takes time with their square",
    )
    peak_threshold: float = Field(
        0.0067, ge=0, le=1, description="keypoints with less contrast after a blur of 1 px are dropped; white is 1"
    )
    blur_px: Annotated[float, Field(ge=0, le=16)] | Literal["auto"] = Field(
        "auto",
        description="standard deviation of the Gaussian that quiets photon noise before detection, in px; "
        "auto takes 1, and up to 2.5 in the dark",
    )
    ratio: float = Field(0.8, gt=0, le=1, description="a match must be so many times nearer than the second best (Lowe 2004)")
    search_px: float = Field(
        12.0, gt=0, description="from the second level on, matches are looked for so far from where the motion known puts them"
    )
    threshold_px: float = Field(2.0, gt=0, le=50, description="a match that fits better than this can be an inlier, in px")
    min_inliers: int = Field(12, ge=5, description="a pair with fewer inliers is not located")
    max_std_px: float = Field(
        10.0, gt=0, description="a pair whose matches pin the corners of the frame down less well than this is not located"
    )
