"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from photonpano import Config, SpecPath
from photonpano.locating import AlignmentConfig, KeypointConfig, MatchingConfig, PyramidConfig


class TorchConfig(Config):
    """What all locators of this plugin can be told."""

    device: Literal["cpu", "cuda"] = Field("cpu", description="where torch computes")


class KorniaRegistratorConfig(TorchConfig, PyramidConfig, AlignmentConfig):
    """Descent of the squared difference in brightness, coarse to fine."""

    max_iterations: int = Field(20, ge=1, le=1000, description="steps of L-BFGS at each level of the pyramid")
    converged_px: float = Field(0.01, gt=0, le=1, description="the alignment is done when a step moves no corner further")


class KorniaFeaturesConfig(TorchConfig, KeypointConfig):
    """SIFT keypoints, matched by SMNN or AdaLAM, RANSAC, least squares."""

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


class KorniaLoftrConfig(TorchConfig, MatchingConfig):
    """LoFTR with weights from a file, RANSAC, least squares."""

    weights: SpecPath = Field(description="a file of weights for LoFTR; nothing is downloaded")
    corrected_positions: bool = Field(
        False, description="whether the weights were trained with the corrected encoding of positions, as `indoor_ds_new` was"
    )
    min_confidence: float = Field(0.2, ge=0, le=1, description="a match of which LoFTR is less certain than this is dropped")
