"""Config of the locator; light enough to be imported when plugins are listed."""

from __future__ import annotations

from pydantic import Field

from photonpano.locating import KeypointConfig


class PycolmapTwoViewConfig(KeypointConfig):
    """COLMAP's features and matches, LO-RANSAC, least squares."""

    max_keypoints: int = Field(
        2000,
        ge=16,
        le=32_768,
        description="number of keypoints kept of an exposure, the largest; the time of matching grows with its square",
    )
    peak_threshold: float = Field(
        0.0067, ge=0, le=1, description="keypoints with less contrast after a blur of 1 px are dropped; white is 1"
    )
