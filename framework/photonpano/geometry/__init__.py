"""Pure functions on homographies and canvases: points are (x, y), integers are pixel centres, maps are float64."""

from typing import TYPE_CHECKING

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
from photonpano.geometry.plausibility import why_implausible
from photonpano.geometry.steps import generators, slopes, unit_coordinates
from photonpano.lazy import imported_on_use

if TYPE_CHECKING:
    from photonpano.geometry.sampling import Run, run_from, sample_run, visible_columns
    from photonpano.geometry.shapes import violation

__all__ = [
    "Canvas",
    "Run",
    "align_planes",
    "apply",
    "canvas_of",
    "corner_displacements",
    "corners",
    "from_parameters",
    "generators",
    "inverse",
    "jacobian",
    "normalised",
    "parameters",
    "rescaled",
    "rescaling",
    "run_from",
    "sample_run",
    "slopes",
    "translation",
    "unit_coordinates",
    "violation",
    "visible_columns",
    "why_implausible",
]

if not TYPE_CHECKING:  # the compiled functions: numba is imported when one of them is used
    __getattr__, __dir__ = imported_on_use(__name__, __all__, ("sampling", "shapes"))
