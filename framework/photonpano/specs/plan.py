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
    """Everything a run needs.

    Attributes:
        source: the capture.
        corrections: the corrections of its frames, in order.
        levels: one plan for each level, in order; none with `pose`, which has no refiners either.
        refine: the refiners that correct the motion after the last level, in order.
        until_converged: the loop ends when the motion has converged, at the latest after the last of `levels`, which are equal.
        renderer: the component that renders the panorama.
        formats: the exporters that write it as files of other formats.
        motion: what the motion of the camera may be.
        camera: what is known of the camera.
        light: whether the light of the scene changes.
        graph: which pairs are registered, and what happens when the graph is disconnected.
        render: the panorama.
        output: the run folder.
        run: seed, threads, memory.
        document: the resolved spec as plain data, defaults filled in; `run.json` records it, and it is a valid spec itself.
        written: the values of `document` with their places, as far as they were written: see `place`.
        file: the spec file, None for a spec that was built in Python.
        observers: the plugins that watch the run.
        decisions: choices that the spec leaves open and that reading it made: the source that recognises the capture.
        corrects_itself: `corrections` is `auto`: the run masks what stands still, and divides by a vignette.
        executor: works on the tasks of the run; None for threads of this process.
        pose: the pose estimator, which takes the place of the levels, of refiners and of the panorama; None for a panorama.
    """

    source: Choice
    corrections: tuple[Correction, ...]
    levels: tuple[LevelPlan, ...]
    refine: tuple[Choice, ...]
    renderer: Choice
    formats: tuple[Choice, ...]
    executor: Choice | None
    until_converged: bool
    motion: MotionSettings
    camera: CameraSettings
    light: LightSettings
    graph: GraphSettings
    render: RenderSettings
    output: OutputSettings
    run: RunSettings
    document: Mapping[str, Any]
    written: Written = field(default=Written({}), repr=False)
    file: Path | None = None
    observers: tuple[Observer, ...] = ()
    decisions: tuple[Decision, ...] = ()
    corrects_itself: bool = False
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
