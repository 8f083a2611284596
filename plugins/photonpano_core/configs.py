"""What specs may say under `with`; light enough to be imported when plugins are listed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from photonpano import Config


class GroupedConfig(Config):
    """What all resamplers share: how long a group is."""

    group_size: Literal["auto"] | Annotated[int, Field(ge=1)] = Field(
        "auto",
        description="frames of a group: more for the dark, fewer for fast motion; auto chooses from flux and speed",
    )


class ConstantGroupsConfig(GroupedConfig):
    """The same groups, side by side, at each level."""


class SlidingWindowConfig(GroupedConfig):
    """A group every so many frames."""

    step_frames: int | None = Field(
        None,
        ge=1,
        description="frames from one group to the next at level 1, or slightly fewer so that the last group ends with the "
        "capture; by default half of a group",
    )
    step_shrink: float = Field(
        1.0, ge=1, le=4, description="the step of each level is that of the level before, divided by this; 1 keeps it"
    )


class DensifyingConfig(GroupedConfig):
    """What the resamplers share whose groups get denser from level to level."""

    endpoints: bool = Field(
        True,
        description="from the second level on, also locate ever shorter groups at both ends, so that the motion there is "
        "measured and not extrapolated (supplement S2)",
    )


class MidpointConfig(DensifyingConfig):
    """Groups of equal size, twice as dense at each level."""


class StratifiedConfig(DensifyingConfig):
    """Groups of equal size, as dense as those of `midpoint`, at instants by chance."""

    jitter: float = Field(
        1.0,
        ge=0,
        le=1,
        description="over which share of its stratum a group may lie; 0 puts it in the middle, as midpoint does",
    )


class PhotonMleConfig(Config):
    """One maximum-likelihood estimate of all photons of a pixel."""

    tolerance_px: float = Field(
        1.0, gt=0, le=8, description="frames are summed before they are warped while they move less than this, in px"
    )
    compensate: bool = Field(
        True, description="warp along the motion known so far; false averages naively, the paper's baseline"
    )


class RobustMergeConfig(Config):
    """Maximum-likelihood merging of what agrees with the frames around the reference instant."""

    blocks: int = Field(
        7,
        ge=2,
        le=64,
        description="each group is divided into so many sums of frames, and each is compared with the one around the "
        "reference instant; an odd number has it in the middle",
    )
    smoothing_px: float = Field(
        2.0,
        ge=0.5,
        le=32,
        description="standard deviation of the Gaussian under which sums are compared, in px of a frame: about the size of the "
        "smallest thing that moves by itself",
    )
    tolerated_std: float = Field(
        3.0, ge=0, le=20, description="a difference of so many standard deviations of the photon noise costs no weight"
    )
    tolerated_px: float = Field(
        0.5, ge=0, le=8, description="nor does one that a motion wrong by so much explains, in px of a frame"
    )
    tolerance_px: float = Field(
        0.5, gt=0, le=8, description="frames are summed before they are warped while they move less than this, in px"
    )


class SplatConfig(Config):
    """Every frame along its own motion: there is nothing to choose."""


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
