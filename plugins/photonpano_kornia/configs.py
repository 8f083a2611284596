"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from photonpano import Config, SpecPath

Blur = Annotated[float, Field(ge=0, le=16)] | Literal["auto"]


class TorchConfig(Config):
    """What all locators of this plugin can be told."""

    device: Literal["cpu", "cuda"] = Field("cpu", description="where torch computes")
    blur_px: Blur = Field(
        "auto",
        description="standard deviation of the Gaussian that quiets photon noise, in px; "
        "auto takes 1, and up to 2.5 in the dark",
    )


class KorniaRegistratorConfig(TorchConfig):
    """Descent of the squared difference in brightness, coarse to fine."""

    pyramid_levels: int = Field(4, ge=1, le=8, description="levels of the pyramid, each half as large as the one before")
    max_iterations: int = Field(20, ge=1, le=1000, description="steps of L-BFGS at each level of the pyramid")
    converged_px: float = Field(0.01, gt=0, le=1, description="the alignment is done when a step moves no corner further")
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


class MatchConfig(TorchConfig):
    """When matched points are believed."""

    search_px: float = Field(
        12.0, gt=0, description="from the second level on, matches are looked for so far from where the motion known puts them"
    )
    threshold_px: float = Field(2.0, gt=0, le=50, description="a match that fits better than this can be an inlier, in px")
    min_inliers: int = Field(12, ge=5, description="a pair with fewer inliers is not located")
    max_std_px: float = Field(
        10.0, gt=0, description="a pair whose matches pin the corners of the frame down less well than this is not located"
    )


class KorniaFeaturesConfig(MatchConfig):
    """SIFT keypoints, matched by SMNN or AdaLAM, RANSAC, least squares."""

    max_keypoints: int = Field(2000, ge=16, le=100_000, description="the strongest keypoints of an exposure that are kept")
    upright: bool = Field(
        True,
        description="keypoints have no orientation of their own, which suits cameras that roll by less than some 15 degrees",
    )
    matcher: Literal["smnn", "adalam"] = Field(
        "smnn", description="smnn asks for mutual nearest neighbours, adalam also for neighbours that move alike"
    )
    ratio: float = Field(
        0.85, gt=0, le=1, description="smnn: a match must be so many times nearer than the second best, seen from both sides"
    )


class KorniaLoftrConfig(MatchConfig):
    """LoFTR with weights from a file, RANSAC, least squares."""

    weights: SpecPath = Field(description="a file of weights for LoFTR; nothing is downloaded")
    corrected_positions: bool = Field(
        False, description="whether the weights were trained with the corrected encoding of positions, as `indoor_ds_new` was"
    )
    min_confidence: float = Field(0.2, ge=0, le=1, description="a match of which LoFTR is less certain than this is dropped")
