"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from photonpano import Config

Blur = Annotated[float, Field(ge=0, le=16)] | Literal["auto"]


class KeypointConfig(Config):
    """How keypoints are matched, and when their matches are believed."""

    max_keypoints: int = Field(2000, ge=16, le=100_000, description="the strongest keypoints of an exposure that are kept")
    blur_px: Blur = Field(
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


class OpencvSiftConfig(KeypointConfig):
    """SIFT keypoints, ratio test, MAGSAC, least squares."""

    contrast_threshold: float = Field(
        0.02,
        ge=0,
        le=1,
        description="keypoints with less contrast after a blur of 1 px are dropped; OpenCV's own default is 0.04",
    )


class OpencvOrbConfig(KeypointConfig):
    """ORB keypoints, ratio test on bits, MAGSAC, least squares."""

    fast_threshold: int = Field(
        20,
        ge=1,
        le=255,
        description="a corner differs from the circle around it by more than this, of 255 between black and white",
    )
    pyramid_levels: int = Field(8, ge=1, le=16, description="sizes at which corners are looked for")
    pyramid_scale: float = Field(1.2, gt=1, le=2, description="how much coarser each of them is than the one before")


class AlignmentConfig(Config):
    """When two images that were aligned by their brightness are believed to show the same."""

    blur_px: Blur = Field(
        "auto",
        description="standard deviation of the Gaussian that quiets photon noise, in px; "
        "auto takes 1, and up to 2.5 in the dark",
    )
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


class OpencvEccConfig(AlignmentConfig):
    """Alignment that maximises the enhanced correlation coefficient, coarse to fine."""

    pyramid_levels: int = Field(4, ge=1, le=8, description="levels of the pyramid, each half as large as the one before")
    max_iterations: int = Field(50, ge=1, le=1000, description="steps at each level of the pyramid")
    converged: float = Field(
        1e-5, gt=0, le=0.1, description="the alignment is done when a step changes the correlation coefficient by less"
    )


class PhaseCorrelationConfig(AlignmentConfig):
    """The shift at which the phases of two images agree."""

    peak_px: float = Field(
        1.5, ge=0.5, le=16, description="standard deviation of the peak that is looked for, in px: wider ones stand more noise"
    )
    max_rounds: int = Field(
        5, ge=1, le=20, description="how often the images are shifted by what was found, and correlated again"
    )
    converged_px: float = Field(0.05, gt=0, le=1, description="the shift is found when a round changes it by less")


class DirectConfig(Config):
    """Inverse-compositional alignment, coarse to fine."""

    blur_px: float = Field(0.8, gt=0, le=16, description="standard deviation of the Gaussian that quiets photon noise, in px")
    pyramid_levels: int = Field(4, ge=1, le=8, description="levels of the pyramid, each half as large as the one before")
    max_iterations: int = Field(30, ge=1, le=1000, description="steps at each level of the pyramid")
    converged_px: float = Field(0.01, gt=0, le=1, description="the alignment is done when a step moves no corner further")
    min_overlap: float = Field(0.1, gt=0, le=1, description="the least share of the image that both exposures must see")
    min_agreement: float = Field(
        0.5,
        ge=0,
        le=1,
        description="a pair whose images, with photon noise taken out, correlate less than this after alignment is not located",
    )
    max_noise_ratio: float = Field(
        100.0,
        gt=1,
        description="a pair that differs by more than this many times its photon noise is not located, "
        "unless there is so much light that blur explains it",
    )
    max_std_px: float = Field(
        15.0,
        gt=0,
        description="a pair whose photons tell less well than this where the corners of the frame lie is not located",
    )
