"""The keys of the baselines in a spec."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from photonpano import Config
from photonpano_core.configs import Tolerance


class BurstConfig(Config):
    """Keys of `burst`."""

    block_frames: int = Field(
        100, ge=1, le=100_000, description="frames of a block; each block is aligned with the one around the reference instant"
    )
    patch_px: Literal[16, 32] = Field(16, description="side of a patch that moves as a whole, in px of a frame")
    tolerance_px: Tolerance = 0.5
