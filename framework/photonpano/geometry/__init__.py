"""Pure functions on homographies and canvases: points are (x, y), integers are pixel centres, maps are float64."""

from photonpano.geometry.alignment import align_planes
from photonpano.geometry.canvas import Canvas, canvas_of
from photonpano.geometry.homographies import (
    apply,
    corner_displacements,
    corners,
    from_parameters,
    inverse,
    jacobian,
    normalised,
    parameters,
    rescaled,
    rescaling,
    translation,
)
from photonpano.geometry.plausibility import implausibility
from photonpano.geometry.steps import generators, slopes, unit_coordinates

__all__ = [
    "Canvas",
    "align_planes",
    "apply",
    "canvas_of",
    "corner_displacements",
    "corners",
    "from_parameters",
    "generators",
    "implausibility",
    "inverse",
    "jacobian",
    "normalised",
    "parameters",
    "rescaled",
    "rescaling",
    "slopes",
    "translation",
    "unit_coordinates",
]
