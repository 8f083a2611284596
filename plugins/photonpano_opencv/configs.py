"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from pydantic import Field

from photonpano.locating import AlignmentConfig, KeypointConfig, PyramidConfig


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


class OpencvEccConfig(PyramidConfig, AlignmentConfig):
    """Alignment that maximises the enhanced correlation coefficient, coarse to fine."""

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
