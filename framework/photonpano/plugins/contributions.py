"""What plugins are made of: the records that offer components, their configs, and what components are told."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol, get_args, get_type_hints

import numpy as np
import pluggy
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetPydanticSchema, ValidationInfo
from pydantic_core import core_schema

from photonpano.contracts.protocols import (
    Arrived,
    Exporter,
    Interpolator,
    Locator,
    Merger,
    Piped,
    Refiner,
    Renderer,
    Resampler,
    RunKind,
    Source,
)
from photonpano.errors import CaptureUnreadError
from photonpano.execution.threads import InOrder
from photonpano.files.paths import Location, Url, given_path, location, refusal
from photonpano.text import install_line
from photonpano.values import CaptureSummary, DecisionValue, Response, StreamInfo

PROJECT = "photonpano"  # the project name of pluggy, and the entry-point group
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


class Config(BaseModel):
    """Base of the configs of components: closed (an unknown key is an error) and frozen.

    Give every field a description, bounds, and its unit in the name or the description.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """One kind of component. Hooks, the reader of specs, the JSON Schema and the conformance kit go by this row."""

    name: str  # what a component of this kind is, such as `locator`
    section: str  # where a spec chooses it, such as `locate` or `output.formats`; empty for kinds of runs
    # the record that the hook yields; what its `build` returns is the interface of the component
    contribution: type[Any] = field(repr=False)
    default: str | None = None  # the component that a spec uses if it names none
    of_level: bool = False  # whether each level of a run has one
    several: bool = False  # whether the section is a list of components
    meaning: str = ""  # what the section chooses, for editors; empty if its keys say so

    @property
    def hook(self) -> str:
        """The hook that offers it, such as `photonpano_locators`."""
        return f"{PROJECT}_{self.name.replace('-', '_')}s"

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods of the component."""
        interface = get_args(get_type_hints(self.contribution)["build"])[-1]
        return tuple(name for name, member in vars(interface).items() if inspect.isfunction(member) and name[0] != "_")


KINDS: dict[str, Kind] = {}
"""All kinds by name, in the order in which a run needs them; each contribution class adds its own."""

API_VERSION = 1
"""The version of the contract with plugins: hooks, contributions, protocols. It changes only when plugins must change."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """A library that a component imports when it is built."""

    module: str  # the name to import, such as `kornia`
    install: str  # what to pass to `pip install`, such as `photonpano[kornia]`


def install_command(requirements: Iterable[Requirement]) -> str:
    """Return the line that installs libraries, from an index and from a checkout of photonpano."""
    return install_line(each.install for each in requirements)


def no_problems(*_: Any) -> Sequence[str]:
    """Find nothing: the default `check` of a contribution."""
    return ()


_KEBAB = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")

_SUFFIX = re.compile(r"(\.[a-z0-9]+)+")
_TAKEN_SUFFIXES = (".tiff", ".png")


@dataclass(frozen=True, kw_only=True)
class Contribution:
    """One component that a plugin offers. Plugins yield the subclasses, one for each kind."""

    kind: ClassVar[str]

    name: str  # its name in specs, in kebab-case
    summary: str  # one line for lists
    config: type[Config]  # the closed, frozen model of the keys under `with`
    # makes the component from an instance of `config` and the context; heavy libraries are imported here, not before
    build: Callable[[Any, Any], Any]
    check: Callable[..., Sequence[str]] = no_problems  # finds problems of a config; see the subclasses
    requires: tuple[Requirement, ...] = ()  # libraries that may be missing, and how to install them
    # the version of the contract that the plugin was made for. A published plugin writes the number, so that a photonpano with
    # another contract refuses it with a clear message.
    api_version: int = API_VERSION

    def __init_subclass__(cls, kind: str = "", **row: Any) -> None:
        super().__init_subclass__()
        if kind:
            cls.kind = kind
            KINDS[kind] = Kind(name=kind, contribution=cls, **row)

    def __post_init__(self) -> None:
        if not _KEBAB.fullmatch(self.name):
            raise ValueError(f"the name of a contribution is kebab-case, such as 'my-{self.kind}'; got {self.name!r}")
        if not self.summary or "\n" in self.summary:
            raise ValueError(f"{self.name}: the summary is one line, got {self.summary!r}")
        if not issubclass(self.config, BaseModel):
            raise TypeError(f"{self.name}: config is a pydantic model class, got {self.config!r}")
        if not isinstance(self.api_version, int):
            raise TypeError(f"{self.name}: api_version is a whole number, such as {API_VERSION}; got {self.api_version!r}")
        settings = self.config.model_config
        if settings.get("extra") != "forbid" or not settings.get("frozen"):
            raise ValueError(
                f"{self.name}: the config must be closed and frozen; derive {self.config.__name__} from photonpano.Config"
            )


@dataclass(frozen=True, slots=True)
class Recognised:
    """The answer of a source that recognises a capture."""

    keys: Mapping[str, Any]  # the keys that open it, the path among them, as a spec would have them under `with`
    because: str  # the reason, as a clause after "it was recognised as ...: ", such as "8,388,608 bytes a file"


class PartOfCapture(Config):
    """The key of every source that the framework applies: which part of the capture to read."""

    frames: FrameRange | None = Field(
        None, description="the part of the capture to read, [start, stop]: frames start to stop - 1; all by default"
    )


def _not_ours(_: Path) -> None:
    """Recognise nothing: the default `recognise` of a source."""


class WriteFrames(Protocol):
    """Writes binary frames as a capture."""

    def __call__(self, folder: Path, info: StreamInfo, frames: Iterable[NDArray[np.uint8]], *, compressed: bool) -> None:
        """Write a capture into an empty folder, which gets its name once this returns.

        Args:
            folder: the folder.
            info: frames, size and rate.
            frames: all packed frames in order, some at a time: (n, height, ceil(width / 8)), as from `PackedSource.packed`.
            compressed: whether to compress them.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class SourceContribution(Contribution, kind="source", section="source"):
    """Offers a source.

    The config gets one more key, `frames`: see `PartOfCapture`. The framework reads that part of what `build` returns.
    """

    build: Callable[[Any, SourceContext], Source]
    # finds problems of a config without reading the capture, such as a missing file
    check: Callable[[Any], Sequence[str]] = no_problems
    # returns the keys of a capture if it is one of this source, for specs that leave the choice to `auto`. It reads names,
    # sizes and a few megabytes at most, imports nothing heavy, and raises nothing.
    recognise: Callable[[Any], Recognised | None] = _not_ours
    # writes binary frames as a capture that this source reads, for `photonpano convert` to a name with one of its `suffixes`;
    # None if it cannot
    write: WriteFrames | None = None
    # whether `recognise` also gets a `photonpano.Url`, which a path of the type `SpecLocation` may be
    recognises_urls: bool = False
    # the endings of its files, in small letters, such as ".npy"; empty for any. If no source recognises a path, the message has
    # the problems of the sources with its ending.
    suffixes: tuple[str, ...] = ()
    # opens what is there of a capture that is still being written, or says that it comes from a pipe, for `photonpano run
    # --follow`; None if this source cannot. It is called twice a second. A file that is not there yet is no error,
    # one that will never be a capture is an `InputError`.
    arrived: Callable[[Any], Arrived | Piped] | None = None

    def __post_init__(self) -> None:
        Contribution.__post_init__(self)
        if issubclass(self.config, PartOfCapture):
            return
        if "frames" in self.config.model_fields:
            raise ValueError(f"{self.name}: the key 'frames' of a source is the framework's; give yours another name")
        own = {"__module__": self.config.__module__, "__doc__": self.config.__doc__}
        object.__setattr__(self, "config", type(self.config.__name__, (PartOfCapture, self.config), own))


@dataclass(frozen=True, kw_only=True)
class StageContribution(Contribution):
    """Offers a component that is built for a capture: of a stage of the levels, a refiner, a renderer, or an exporter."""

    # finds problems of a config with a capture, from its description; reads no data, imports nothing heavy
    check: Callable[[Any, StreamInfo], Sequence[str]] = no_problems


@dataclass(frozen=True, kw_only=True)
class ResamplerContribution(StageContribution, kind="resampler", section="resample", default="midpoint", of_level=True):
    """Offers a resampler."""

    build: Callable[[Any, StageContext], Resampler]


@dataclass(frozen=True, kw_only=True)
class MergerContribution(StageContribution, kind="merger", section="merge", default="photon-mle", of_level=True):
    """Offers a merger."""

    build: Callable[[Any, StageContext], Merger]
    # whether it merges corrected sums. The framework then divides the sums of frames by a vignette that it finds.
    accepts_corrected_sums: bool = True
    # whether it leaves out by itself what `Capture.masks` name, and what hides `Capture.background`, or merges that sharply.
    # Any other merger gets a capture in which the pixels are masked that are to be left out at any time of the group.
    handles_movers: bool = False


@dataclass(frozen=True, kw_only=True)
class LocatorContribution(StageContribution, kind="locator", section="locate", default="direct", of_level=True):
    """Offers a locator."""

    build: Callable[[Any, StageContext], Locator]


@dataclass(frozen=True, kw_only=True)
class InterpolatorContribution(
    StageContribution, kind="interpolator", section="interpolate", default="smoothing-spline", of_level=True
):
    """Offers an interpolator."""

    build: Callable[[Any, StageContext], Interpolator]


@dataclass(frozen=True, kw_only=True)
class RefinerContribution(
    StageContribution,
    kind="refiner",
    section="refine",
    default="short-spans",
    several=True,
    meaning="the refiners that correct the motion after the last level, in order: one or a list, each a name or {use, with}",
):
    """Offers a refiner."""

    build: Callable[[Any, StageContext], Refiner]


@dataclass(frozen=True, kw_only=True)
class RendererContribution(StageContribution, kind="renderer", section="render", default="merge"):
    """Offers a renderer."""

    build: Callable[[Any, StageContext], Renderer]
    # peak memory of rendering for a pixel of the canvas. The framework renders a canvas that exceeds the memory of the run in
    # tiles.
    bytes_per_pixel: int = 40
    # whether it divides by the gains of `Capture.light`, as `photonpano.merging.accumulate` does. If not, a run in changing
    # light warns that the panorama shows the light of the moment.
    divides_by_light: bool = False
    # whether it renders on a canvas of any projection, and frames through the lens of their camera, as
    # `photonpano.merging.accumulate` does. If not, a run that needs it is refused.
    renders_on_any_canvas: bool = False

    def __post_init__(self) -> None:
        StageContribution.__post_init__(self)
        if type(self.bytes_per_pixel) is not int or self.bytes_per_pixel < 1:
            raise ValueError(f"{self.name}: bytes_per_pixel is a whole number of at least 1, got {self.bytes_per_pixel!r}")


@dataclass(frozen=True, kw_only=True)
class ExporterContribution(
    StageContribution,
    kind="exporter",
    section="output.formats",
    several=True,
    meaning="further files of the panorama, beside panorama.tiff and panorama.png: one or a list, each a name or {use, with}",
):
    """Offers an exporter."""

    build: Callable[[Any, StageContext], Exporter]
    suffix: str  # the ending of its file or folder, in small letters, such as ".exr": the run folder gets `panorama.exr`

    def __post_init__(self) -> None:
        StageContribution.__post_init__(self)
        if not _SUFFIX.fullmatch(self.suffix):
            raise ValueError(f"{self.name}: suffix is a dot and small letters or digits, such as .exr, got {self.suffix!r}")
        if self.suffix in _TAKEN_SUFFIXES:
            raise ValueError(f"{self.name}: every run writes panorama{self.suffix} itself; choose another suffix")


@dataclass(frozen=True, kw_only=True)
class RunKindContribution(Contribution, kind="run-kind", section=""):
    """Offers a kind of run that finds something else than a panorama. Experimental: the record may change with any version.

    Its name is what it finds, in the plural, such as "poses": messages have it, and `run.json` has what was found under it.
    """

    build: Callable[[Any, Any], RunKind]
    # the record of the components that find it: a spec with their section asks for such a run, and has none of a panorama
    component: type[StageContribution]
    file: str  # the file by which the run folder of such a run is known, such as "poses.npz"
    truth: str = ""  # the array by which the truth of its captures is known, such as "camera_from_world"
    config: type[Config] = Config

    @property
    def section(self) -> str:
        """The section of a spec that asks for such a run."""
        return KINDS[self.component.kind].section

    @property
    def runs(self) -> RunKind:
        """What does such runs, with the libraries that it needs."""
        return self.build(self.config(), None)


@dataclass(frozen=True, kw_only=True)
class ExecutorContribution(
    Contribution,
    kind="executor",
    section="run.executor",
    meaning="what works on the tasks of the run: a name, or {use, with}; by default threads of this process",
):
    """Offers an executor. Experimental: the record may change with any version."""

    build: Callable[[Any, ExecutorContext], Executor]
