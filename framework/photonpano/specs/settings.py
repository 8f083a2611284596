"""The framework's own sections of a spec, with their defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ByteSize, Field

from photonpano.contributions import Config, SpecPath


class LevelSettings(Config):
    """What a level says of itself, beside the stages that it overrides."""

    scale: Literal["auto"] | Annotated[float, Field(ge=0.05, le=4)] = Field(
        "auto",
        description="pixels of the level's exposures per pixel of a frame; auto takes 0.5 at the first two levels, which later "
        "ones refine, and 1 at the last, at any further one, and where frames are small",
    )


class GraphSettings(Config):
    """Which pairs of exposures are registered, and what happens when too few are located."""

    skips: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (1.0, 2.0, 4.0),
        description="each exposure is registered with those so many group lengths away; an empty list leaves a chain of "
        "neighbours",
    )
    closure_overlap: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        0.5,
        description="exposures that see one place at different times are registered too if they share so much of the field "
        "of view; null registers none",
    )
    disconnected: Literal["error", "largest"] = Field(
        "error",
        description="when some exposures cannot be tied to the others: stop with an error that names them, "
        "or go on with the largest part",
    )


class RenderSettings(Config):
    """The panorama."""

    scale: float = Field(1.0, ge=0.05, le=16, description="pixels of the panorama per pixel of the reference frame")
    reference: Literal["first", "middle", "last"] | Annotated[int, Field(ge=0)] = Field(
        "middle", description="the frame whose plane the panorama lies in: first, middle, last, or a frame index"
    )
    tolerance_px: float = Field(
        0.125,
        gt=0,
        le=8,
        description="frames are summed before they are warped while they move less than this, in px; 0.25 costs 0.07 dB of a "
        "sharp scene in good light, and half the time",
    )
    white_quantile: float = Field(0.995, gt=0, le=1, description="the quantile of flux that becomes white in panorama.png")


class OutputSettings(Config):
    """The run folder."""

    directory: SpecPath = Field(description="the run folder; by default `runs/` and the name of the spec, beside the spec")


class RunSettings(Config):
    """How the run uses the machine."""

    seed: int = Field(0, ge=0, description="all randomness of the run derives from it")
    threads: Literal["auto"] | Annotated[int, Field(ge=1, le=1024)] = Field(
        "auto", description="threads to use; auto takes one for each core"
    )
    memory: ByteSize = Field(
        ByteSize(2 * 1024**3),
        ge=64 * 1024**2,
        description="a panorama that would take more memory than this is rendered in parts; one that is more than 16 times as "
        "large is refused",
    )
