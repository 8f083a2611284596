"""A spec that has been resolved against a catalog: what the pipeline runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from photonpano.corrections import Correction
from photonpano.errors import InputError
from photonpano.plugins.contributions import Config, Contribution
from photonpano.plugins.registry import Observer, Origin
from photonpano.specs.settings import (
    CameraSettings,
    GraphSettings,
    LightSettings,
    MotionSettings,
    OutputSettings,
    RenderSettings,
    RunSettings,
)
from photonpano.specs.written import Place, Written
from photonpano.values import Decision


@dataclass(frozen=True, slots=True)
class Choice:
    """A component chosen by name, with its validated config, at a place of the spec."""

    contribution: Contribution
    config: Config
    origin: Origin
    place: Place = field(default=Place(), compare=False)

    @property
    def label(self) -> str:
        """Kind, name, distribution and version, for messages, such as "merger 'photon-mle' of photonpano 0.1.0"."""
        return self.origin.label(self.contribution.kind, self.contribution.name)


@dataclass(frozen=True, slots=True)
class LevelPlan:
    """The components of one level, and its scale; pairs that `locate` loses are offered to the `fallbacks`, in order."""

    resample: Choice
    merge: Choice
    locate: Choice
    fallbacks: tuple[Choice, ...]
    interpolate: Choice
    scale: float | Literal["auto"]


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything a run needs."""

    source: Choice  # the capture
    corrections: tuple[Correction, ...]  # the corrections of its frames, in order
    levels: tuple[LevelPlan, ...]  # one plan for each level, in order; none with `pose`, which has no refiners either
    refine: tuple[Choice, ...]  # the refiners that correct the motion after the last level, in order
    renderer: Choice  # the component that renders the panorama
    formats: tuple[Choice, ...]  # the exporters that write it as files of other formats
    executor: Choice | None  # works on the tasks of the run; None for threads of this process
    # the loop ends when the motion has converged, at the latest after the last of `levels`, which are equal
    until_converged: bool
    motion: MotionSettings  # what the motion of the camera may be
    camera: CameraSettings  # what is known of the camera
    light: LightSettings  # whether the light of the scene changes
    graph: GraphSettings  # which pairs are registered, and what happens when the graph is disconnected
    render: RenderSettings  # the panorama
    output: OutputSettings  # the run folder
    run: RunSettings  # seed, threads, memory
    # the resolved spec as plain data, defaults filled in; `run.json` records it, and it is a valid spec itself
    document: Mapping[str, Any]
    # the values of `document` with their places, as far as they were written: see `place`
    written: Written = field(default=Written({}), repr=False)
    file: Path | None = None  # the spec file, None for a spec that was built in Python
    observers: tuple[Observer, ...] = ()  # the plugins that watch the run
    recognised: Decision | None = None  # the source that recognised the capture, where the spec leaves it open
    corrects_itself: bool = False  # `corrections` is `auto`: the run masks what stands still, and divides by a vignette
    # the pose estimator, which takes the place of the levels, of refiners and of the panorama; None for a panorama
    pose: Choice | None = None

    def having(self, section: str, **values: Any) -> Plan:
        """Return this plan with other values of keys of a section; for `source`, of keys of its component."""
        of_source, written = section == "source", self.document[section]
        found: Any = (self.source.config if of_source else getattr(self, section)).model_copy(update=values)
        plain = found.model_dump(mode="json", by_alias=True, include=set(values))
        if of_source:
            found, plain = replace(self.source, config=found), {"with": {**written["with"], **plain}}
        changed = {section: found, "document": {**self.document, section: {**written, **plain}}}
        return replace(self, **changed)

    def place(self, where: str) -> Place:
        """Return where a value was written, by its path in `document`; for a default, where it would stand."""
        return self.written.at(*where.split(".")).place

    def error(self, where: str, message: str) -> InputError:
        """Return the error of a value, by its path in `document`, that does not suit the capture."""
        return InputError(str(self.place(where).problem(message)))
