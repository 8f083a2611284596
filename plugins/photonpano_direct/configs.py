"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from pydantic import Field

from photonpano.locating import ImageLimits, PyramidConfig


class DirectConfig(PyramidConfig, ImageLimits):
    """Inverse-compositional alignment, coarse to fine."""

    blur_px: float = Field(0.8, gt=0, le=16, description="standard deviation of the Gaussian that quiets photon noise, in px")
    max_iterations: int = Field(30, ge=1, le=1000, description="steps at each level of the pyramid")
    converged_px: float = Field(0.01, gt=0, le=1, description="the alignment is done when a step moves no corner further")
    max_noise_ratio: float = Field(
        100.0,
        gt=1,
        description="a pair that differs by more than this many times its photon noise is not located, "
        "unless there is so much light that blur explains it",
    )
