"""What this plugin contributes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import SourceContribution, hookimpl
from photonpano_sensors.intensity.contributions import INTENSITY_SOURCES
from photonpano_sensors.single_photon import SINGLE_PHOTON

if TYPE_CHECKING:
    from collections.abc import Iterator


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer captures as cameras and their programs write them."""
    yield from SINGLE_PHOTON
    yield from INTENSITY_SOURCES
