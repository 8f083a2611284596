"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from photonpano import Config


class MidpointConfig(Config):
    """Groups of equal size, twice as dense at each level."""

    group_size: Literal["auto"] | Annotated[int, Field(ge=1)] = Field(
        "auto",
        description="frames of a group: more for the dark, fewer for fast motion; auto chooses from flux and speed",
    )
    endpoints: bool = Field(
        True,
        description="from the second level on, also locate ever shorter groups at both ends, so that the motion there is "
        "measured and not extrapolated (supplement S2)",
    )
    densify: bool = Field(
        True,
        description="add groups between those of the level before; false keeps their number constant, which is the "
        "paper's failing ablation",
    )


class PhotonMleConfig(Config):
    """One maximum-likelihood estimate of all photons of a pixel."""

    tolerance_px: float = Field(
        1.0, gt=0, le=8, description="frames are summed before they are warped while they move less than this, in px"
    )
    compensate: bool = Field(
        True, description="warp along the motion known so far; false averages naively, the paper's baseline"
    )


class InterpolatorConfig(Config):
    """What all interpolators share: how they go on beyond the knots."""

    hold_frames: float | None = Field(
        None,
        ge=0,
        description="how many frames beyond the last located instant the velocity is held before the motion stops; "
        "by default twice the mean distance of located instants",
    )


class LucasKanadeConfig(InterpolatorConfig):
    """A spline through the eight parameters p1..p8."""


class SmoothingSplineConfig(InterpolatorConfig):
    """A spline of p1..p8 that passes the knots as closely as their noise deserves."""


class GeodesicConfig(InterpolatorConfig):
    """Constant velocity from each knot to the next."""


class LieConfig(InterpolatorConfig):
    """A smooth curve through the knots, in the group of the homographies."""
