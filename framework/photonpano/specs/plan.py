"""A spec that is resolved against a catalog: what its sections are validated with, and the plan that the pipeline runs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from photonpano.corrections import Correction
from photonpano.errors import InputError, Problem
from photonpano.plugins.contributions import KINDS, Config, Contribution, RunKindContribution
from photonpano.plugins.description import (
    Schema,
    alternative,
    alternatives,
    config_schema,
    discriminator,
    expectation,
    subschema,
)
from photonpano.plugins.registry import Catalog, Observer, Origin
from photonpano.specs.settings import (
    NOT_SETTINGS,
    SECTIONS,
    SETTINGS,
    CameraSettings,
    GraphSettings,
    LightSettings,
    MotionSettings,
    OutputSettings,
    RenderSettings,
    RunSettings,
)
from photonpano.specs.yaml_reader import Place, Written, given
from photonpano.text import listed, suggestion
from photonpano.values import Decision


@dataclass
class Spec:
    """A spec while it is resolved."""

    root: Written
    catalog: Catalog = field(default_factory=Catalog)
    directory: Path = Path()  # what relative paths count from
    arriving: bool = False  # whether the capture is still being written, so that its files are not checked
    problems: list[Problem] = field(default_factory=list)
    recognised: Decision | None = None  # the source that recognised the capture, where the spec leaves it open
    remark: str = ""  # added to the message of every problem

    @property
    def kind(self) -> RunKindContribution | None:
        """The kind of run that the spec asks for; None for a panorama."""
        kinds = self.catalog.run_kinds.items()
        return next((kind for section, kind in kinds if section in self.root.data), None)

    @property
    def sections(self) -> tuple[str, ...]:
        """All sections, those of kinds of runs included."""
        return (*SECTIONS, *self.catalog.run_kinds)

    def wrong(self, value: Written, message: str) -> None:
        """Report a problem with a value."""
        place = value.place
        line, column = place.start or (place.line, place.column)
        self.wrong_key(Written(None, replace(place, line=line, column=column)), message)

    def wrong_key(self, value: Written, message: str) -> None:
        """Report a problem with the key of a value: one that is unknown, or missing."""
        if value.place.is_readable:
            self.problems.append(value.place.problem(message + self.remark))

    def mapping(self, value: Written, example: str = "") -> Written | None:
        """Return a section, where nothing counts as an empty mapping; anything but a mapping is a problem, and None."""
        if value.data is None:
            return Written({}, value.place)
        if isinstance(value.data, dict):
            return value
        self.wrong(value, f"expected a mapping{example}, got {given(value.data)}")
        return None

    def check_keys(self, section: Written, known: Iterable[str], below: Iterable[str] = ()) -> None:
        """Report unknown keys of a mapping; those `below` belong under its `with`."""
        for key, value in section.data.items():
            if key not in known:
                message = "unknown key; it belongs under `with`" if key in below else self.unknown_key(key, section, known)
                self.wrong_key(value, message)

    def unknown_key(self, key: str, section: Written, known: Iterable[str]) -> str:
        """Return the message for an unknown key: where it belongs, else the nearest of the keys that are known."""
        if key in self.sections:
            return f"unknown key; `{key}` is a section of its own, not part of another"
        here = re.sub(r"levels\.\d+\.", "", section.place.where)
        if homes := [f"`{home}`" for home in self._homes(key) if home != here]:
            return f"unknown key; it belongs under {listed(homes, 'or')}"
        return f"unknown key; {suggestion(key, known) or 'no keys are allowed here'}"

    def _homes(self, key: str) -> Iterator[str]:
        """Yield the sections where a key may stand, for the components that the spec chooses."""
        for kind in KINDS.values():
            section = self.root.at(*kind.section.split("."))
            is_list = kind.several and section.data is not None
            for item in section.items() if is_list else [section]:
                name = item.spelled_out().at("use").data or (None if is_list else kind.default)
                if key in self.catalog.keys_of(kind.name, name):
                    yield f"{item.place.where}.with"
        yield from (name for name, model in SETTINGS.items() if key in model.model_fields)
        if key == "fallback":
            yield "locate"


ModelT = TypeVar("ModelT", bound=BaseModel)

# Errors that a validator of the model raised itself: its sentence is the message.
RAISED = {"value_error", "assertion_error"}
# Errors, beside those of type, whose message is what the schema expects and what was given.
EXPECTED = {
    *("greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number", "multiple_of"),
    *("too_short", "too_long", "string_too_short", "string_too_long", "string_pattern_mismatch"),
    *("literal_error", "enum", "byte_size", "byte_size_unit", "missing"),
}
NUMBER = re.compile(r"\s*[-+]?[\d.]+([eE][-+]?\d+)?\s*")


def validate(model: type[ModelT], section: Written, spec: Spec) -> ModelT | None:
    """Validate a section, where nothing counts as an empty mapping; None if it has problems, which are added to the spec.

    Types are those of YAML, so text is no number and a number no switch.
    """
    content = spec.mapping(section)
    if content is None:
        return None
    try:
        return model.model_validate_json(json.dumps(content.plain()), strict=True, context={"directory": spec.directory})
    except ValidationError as error:
        schema, n_problems = config_schema(model), len(spec.problems)
        for each in error.errors(include_url=False):
            _report(each, content, schema, spec)
        # The alternatives of a union fail one by one, with one sentence.
        spec.problems[n_problems:] = dict.fromkeys(spec.problems[n_problems:])
    return None


def _report(error: ErrorDetails, value: Written, root: Schema, spec: Spec) -> None:
    kind, steps, schema = error["type"], list(error["loc"]), root
    # The last step is a key that is missing or unknown, or an item that is missing.
    last = steps.pop() if kind in ("missing", "extra_forbidden") else ""
    for step in steps:
        if value.at(step).place.is_written:
            schema, value = subschema(schema, step, root), value.at(step)
        else:  # the step names an alternative of a union
            schema = alternative(schema, step, root)
    tag_key, tags = discriminator(schema, root)
    if kind == "missing" and isinstance(last, str):
        spec.wrong_key(value.at(last), f"required: {expectation(subschema(schema, last, root), root)}")
    elif kind == "extra_forbidden":
        known = [key for option in alternatives(schema, root) for key in option.get("properties", ())]
        known += NOT_SETTINGS.get(value.place.where, ())
        spec.wrong_key(value.at(last), spec.unknown_key(str(last), value, known))
    elif kind == "union_tag_not_found" and tag_key:
        spec.wrong_key(value.at(tag_key), f"required: {listed(tags, 'or')}")
    elif kind == "union_tag_invalid" and tag_key:
        spec.wrong(value.at(tag_key), f"expected {listed(tags, 'or')}, got {given(value.at(tag_key).data)}")
    elif kind in RAISED:
        spec.wrong(value, str(error["ctx"]["error"]))
    elif schema and (kind in EXPECTED or kind.endswith("_type")):
        number = kind in ("int_type", "float_type") and isinstance(value.data, str) and NUMBER.fullmatch(value.data)
        got = f"the text {given(value.data)}; leave the quotes out" if number else given(value.data)
        spec.wrong(value, f"expected {expectation(schema, root)}, got {got}")
    else:
        spec.wrong(value, f"{error['msg'][:1].lower()}{error['msg'][1:]}, got {given(value.data)}")


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
    levels: tuple[LevelPlan, ...]  # one plan for each level, in order; none with a `kind`, which has no refiners either
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
    # the kind of a run that finds something else than a panorama, and what finds it, in the place of levels and refiners
    kind: RunKindContribution | None = None
    finder: Choice | None = None

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
