"""What components are given: their configs, the paths in them, and the run and the capture that they are built for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetPydanticSchema, ValidationInfo
from pydantic_core import core_schema

from photonpano.errors import CaptureUnreadError
from photonpano.execution import CaptureElsewhere
from photonpano.execution.threads import InOrder
from photonpano.files.paths import Location, Url, given_path, location, refusal
from photonpano.values import CaptureSummary, DecisionValue, Response, StreamInfo


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


@dataclass(frozen=True, slots=True)
class SourceContext:
    """The run for which a source is built."""

    seed: int = 0  # the seed of the run; all randomness derives from it
    threads: int = 1  # the number of threads that the component may use


def _unread() -> CaptureSummary:
    raise CaptureUnreadError("chosen from flux and speed when the capture is read")


def _not_recorded(what: str, value: DecisionValue, reason: str) -> None:
    """Record nothing: the default `decide` of a context."""


@dataclass(frozen=True, slots=True)
class StageContext:
    """The run for which any component but a source is built."""

    stream: StreamInfo  # the capture's frames, size and rate
    response: Response  # the camera's response
    seed: int = 0  # the seed of the run; all randomness derives from it
    threads: int = 1  # the number of threads that the component may use
    # returns the flux and the speed of the capture, which are measured at the first call. Raises `CaptureUnreadError` where a
    # spec is only explained: call it when the component works, not when it is built.
    capture: Callable[[], CaptureSummary] = field(default=_unread, compare=False)
    # records a choice that the spec leaves to the component: what was chosen, its value (a number, a text, true or false), and
    # a clause with the reason. `run.json` and the report list it.
    decide: Callable[[str, DecisionValue, str], None] = field(default=_not_recorded, compare=False)
    # calls a function with each of some items, several at once, and yields the results in order. Other processes or machines
    # may do the work: there the function is a copy, pickled with all that it holds.
    in_order: InOrder = field(default=map, compare=False)


@dataclass(frozen=True, slots=True)
class ExecutorContext:
    """The run for which an executor is built."""

    threads: int  # the number of threads of the run
    capture: CaptureElsewhere  # what stands for the capture in tasks of other processes
    # what this process has of what the run needs, by name: versions of photonpano, of the plugins of the run and of libraries,
    # and a hash of the capture
    here: Mapping[str, str]
    elsewhere: Callable[[], Mapping[str, str]]  # tells the same of another process, which must have the same; can be pickled
