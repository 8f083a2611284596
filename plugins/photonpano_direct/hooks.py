"""Config and hooks of the plugin; light enough to be imported when plugins are listed."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import Field

import photonpano_direct as plugin
from photonpano import LocatorContribution, hookimpl
from photonpano.locating import ImageLimits, PyramidConfig


class DirectConfig(PyramidConfig, ImageLimits):
    """Inverse-compositional alignment, coarse to fine."""

    blur_px: float = Field(0.8, gt=0, le=16, description="standard deviation of the Gaussian blur against photon noise, in px")
    max_iterations: int = Field(30, ge=1, le=1000, description="largest number of steps on a level of the pyramid")
    converged_px: float = Field(0.01, gt=0, le=1, description="converged when a step moves no corner further than this")
    max_noise_ratio: float = Field(
        100.0,
        gt=1,
        description="largest difference of the aligned images, in multiples of photon noise; a pair above it is not "
        "located, unless blur in bright light explains it",
    )


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer direct alignment."""
    yield LocatorContribution(
        name="direct",
        summary="Inverse-compositional alignment of brightness, coarse to fine, weighted by photon statistics",
        config=DirectConfig,
        build=lambda config, _: plugin.DirectLocator(config),
    )
