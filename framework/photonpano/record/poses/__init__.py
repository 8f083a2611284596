"""Poses of a camera: their gauge, and the files in which other programs read them."""

from photonpano.record.poses.formats import (
    POSE_FORMATS,
    PoseFormat,
    Poses,
    centres,
    colmap,
    in_standard_world,
    nerfstudio,
    openmvg,
    ply,
    read_colmap,
    tum,
)

__all__ = [
    "POSE_FORMATS",
    "PoseFormat",
    "Poses",
    "centres",
    "colmap",
    "in_standard_world",
    "nerfstudio",
    "openmvg",
    "ply",
    "read_colmap",
    "tum",
]
