"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator

from photonpano import SourceContribution, hookimpl
from photonpano_sensors.bin_files import SPAD512, SPAD512_SPARSE, SPIKE_DAT, SWISSSPAD_FULL, SWISSSPAD_HALF
from photonpano_sensors.event_lists import EVENTS
from photonpano_sensors.hdf5_files import MAT_PARTS, UBICEPT_H5
from photonpano_sensors.intensity.contributions import INTENSITY_SOURCES
from photonpano_sensors.visionsim import VISIONSIM


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer sources of captures in the formats of cameras and their programs."""
    yield from (SWISSSPAD_HALF, SWISSSPAD_FULL, SPAD512, SPAD512_SPARSE, MAT_PARTS, VISIONSIM, UBICEPT_H5, SPIKE_DAT, EVENTS)
    yield from INTENSITY_SOURCES
