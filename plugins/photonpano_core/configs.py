"""Configs of the components, the keys under `with` of a spec. This module imports no heavy library."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from photonpano import Config

Tolerance: TypeAlias = Annotated[
    float,
    Field(gt=0, le=8, description="motion within which frames are summed before they are warped, in px of a frame"),
]


class GroupedConfig(Config):
    """Key of all resamplers: the length of a group."""

    group_size: Literal["auto"] | Annotated[int, Field(ge=1)] = Field(
        "auto",
        description="frames of a group: more in the dark, fewer for fast motion; auto chooses from flux and speed",
    )


class SlidingWindowConfig(GroupedConfig):
    """Keys of `sliding-window`."""

    step_frames: int | None = Field(
        None,
        ge=1,
        description="frames from one group to the next at level 1, rounded down so that the last group ends with the "
        "capture; half a group by default",
    )
    step_shrink: float = Field(
        1.0, ge=1, le=4, description="factor by which the step shrinks from each level to the next; 1 keeps it"
    )


class MidpointConfig(GroupedConfig):
    """Keys of `midpoint`."""

    endpoints: bool = Field(
        True,
        description="from the second level on, also locate ever shorter groups at both ends, so that the motion there is "
        "measured, not extrapolated (supplement S2)",
    )


class StratifiedConfig(MidpointConfig):
    """Keys of `stratified`."""

    jitter: float = Field(
        1.0,
        ge=0,
        le=1,
        description="share of its stratum over which the position of a group is random; 0 keeps the middle, as midpoint does",
    )


class PhotonMleConfig(Config):
    """Keys of `photon-mle`."""

    tolerance_px: Tolerance = 1.0
    compensate: bool = Field(
        True,
        description="warp along the motion known so far; false averages frames as they are, the paper's baseline",
    )


class LocalFlowConfig(Config):
    """Keys of `local-flow`."""

    sub_exposures: Literal["auto", 3, 5, 9, 17, 33] = Field(
        "auto",
        description="parts of a group that are compared and weighted; auto takes 17 of at least 8 photons per pixel each, "
        "33 where something moves fast, else 9, 5 or 3 of at least 2, and in less light merges as photon-mle does",
    )
    significance: float = Field(
        4.0,
        ge=2,
        le=100,
        description="difference of the parts, in standard deviations of the photon noise, above which a pixel moves by itself",
    )
    tolerated_px: float = Field(
        0.3, ge=0, le=8, description="error of the global motion, in px of a frame, that does not count as such a difference"
    )
    tolerance_px: Tolerance = 0.5


class ShortSpansConfig(Config):
    """Keys of `short-spans`."""

    smallest_px: float = Field(
        0.04,
        ge=0,
        le=10,
        description="smallest motion that is corrected: its root mean square over the capture, in px of a frame",
    )


class NoKeys(Config):
    """A component without keys."""


class InterpolatorConfig(Config):
    """Key of all interpolators: extrapolation beyond the knots."""

    hold_frames: float | None = Field(
        None,
        ge=0,
        description="frames beyond the last located instant for which the velocity is kept before the motion stops; "
        "twice the mean distance of located instants by default",
    )


class SuperResolutionConfig(Config):
    """Keys of `super-resolution`."""

    fill_factor: float = Field(
        1.0,
        ge=0.05,
        le=1,
        description="share of the area of a pixel that is sensitive to light; 0.105 for SwissSPAD2 without "
        "microlenses, 1 with good ones",
    )


class ExrConfig(Config):
    """An OpenEXR file."""

    compression: Literal["zip", "zips", "none"] = Field(
        "zip", description="compression, without loss: zip of 16 rows, zips of single rows, or none"
    )
