"""The sources of single-photon captures."""

from __future__ import annotations

from photonpano import SourceContribution
from photonpano_sensors.mat_parts import MAT_PARTS
from photonpano_sensors.spad512 import SPAD512
from photonpano_sensors.spad512_sparse import SPAD512_SPARSE
from photonpano_sensors.swissspad import SWISSSPAD_FULL, SWISSSPAD_HALF
from photonpano_sensors.ubicept import UBICEPT_H5
from photonpano_sensors.visionsim import VISIONSIM

SINGLE_PHOTON: tuple[SourceContribution, ...] = (
    SWISSSPAD_HALF,
    SWISSSPAD_FULL,
    SPAD512,
    SPAD512_SPARSE,
    MAT_PARTS,
    VISIONSIM,
    UBICEPT_H5,
)
