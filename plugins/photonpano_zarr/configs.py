"""The configs of zarr arrays and of OME-Zarr."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from photonpano import Config, SpecLocation


class ZarrConfig(Config):
    """A capture in an array of zarr version 3: uint8 (frames, height, ceil(width / 8)), eight pixels to a byte, or bits."""

    path: SpecLocation = Field(description="the folder of the array, or its URL")
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; by default from the array, if known")
    width: int | None = Field(
        None, ge=1, description="columns of a frame, in px; by default from the array, or else eight for each byte"
    )
    holds: Literal["packed", "bits"] = Field(
        "packed", description="packed: eight pixels to a byte; bits: a pixel to a value, 0 and 1, 0 and 255, or bool"
    )
    bit_order: Literal["big", "little"] | None = Field(
        None,
        description="big if the first of eight pixels is the highest bit of its byte, little if it is the lowest; by default "
        "from the array, or else big, and frames that show another order are refused",
    )


class OmeZarrConfig(Config):
    """A panorama as OME-Zarr, which needs no keys."""
