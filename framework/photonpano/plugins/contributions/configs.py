"""The configs of components, and the paths in them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetPydanticSchema, ValidationInfo
from pydantic_core import core_schema

from photonpano.files.paths import Location, Url, given_path, location, refusal


class Config(BaseModel):
    """Base of the configs of components: closed (an unknown key is an error) and frozen.

    Give every field a description, bounds, and its unit in the name or the description.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _relative_to_spec(path: Path, info: ValidationInfo) -> Path:
    directory = (info.context or {}).get("directory")
    if isinstance(url := location(path), Url):
        raise ValueError(f"{url} is a URL, and this must be a file: download it, and name the file")
    path = given_path(path)
    path = path if directory is None else Path(directory) / path
    if reason := refusal(path):
        raise ValueError(reason)
    try:
        path.exists()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from error
    return path


SpecPath = Annotated[Path, AfterValidator(_relative_to_spec)]
"""A path in a config: relative paths count from the folder of the spec, and arrive in the component resolved.

Named pipes, devices and sockets are refused: they are not files that can be read twice. So are URLs: see `SpecLocation`.
"""


def _in_order(frames: tuple[int, int]) -> tuple[int, int]:
    if frames[0] >= frames[1]:
        raise ValueError(f"expected [start, stop] with start < stop, got {list(frames)}")
    return frames


FrameRange = Annotated[
    tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]],
    AfterValidator(_in_order),
]
"""Frames in a config, [start, stop]: frames start to stop - 1."""


def _url_or(value: Any, path: core_schema.ValidatorFunctionWrapHandler) -> Any:
    found = location(value) if isinstance(value, str | Path | Url) else value
    return found if isinstance(found, Url) else path(value)


def _location_schema(_: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
    as_text = core_schema.to_string_ser_schema(when_used="json")
    return core_schema.no_info_wrap_validator_function(_url_or, handler.generate_schema(SpecPath), serialization=as_text)


SpecLocation = Annotated[Location, GetPydanticSchema(_location_schema)]
"""A path, as `SpecPath`, or a URL, such as `s3://bucket/cube.npy`, which arrives in the component as a `photonpano.Url`.

It is for sources that read through `photonpano.reading`, which opens both.
"""
