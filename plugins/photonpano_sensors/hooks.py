"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator

from photonpano import SourceContribution, hookimpl
from photonpano_sensors.bin_files import SPAD512, SWISSSPAD_FULL, SWISSSPAD_HALF
from photonpano_sensors.intensity.contributions import INTENSITY_SOURCES
from photonpano_sensors.mat_parts import MAT_PARTS
from photonpano_sensors.spad512_sparse import SPAD512_SPARSE
from photonpano_sensors.spike_dat import SPIKE_DAT
from photonpano_sensors.ubicept import UBICEPT_H5
from photonpano_sensors.visionsim import VISIONSIM


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer sources of captures in the formats of cameras and their programs."""
    yield from (SWISSSPAD_HALF, SWISSSPAD_FULL, SPAD512, SPAD512_SPARSE, MAT_PARTS, VISIONSIM, UBICEPT_H5, SPIKE_DAT)
    yield from INTENSITY_SOURCES
