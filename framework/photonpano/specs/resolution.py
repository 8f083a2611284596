"""Resolve a spec against a catalog: from values with places to a plan, or to all of its problems."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from photonpano.errors import PluginError, SpecError
from photonpano.registry.auto import AUTO
from photonpano.registry.chain import CHAIN
from photonpano.registry.kinds import KINDS
from photonpano.specs.auto import found_source
from photonpano.specs.chain import NO_PART, spelled_out
from photonpano.specs.checks import STAGES, complaints
from photonpano.specs.corrections import resolved_corrections, written_corrections
from photonpano.specs.plan import Choice, LevelPlan, Plan
from photonpano.specs.settings import GraphSettings, LevelSettings, OutputSettings, RenderSettings, RunSettings
from photonpano.specs.tree import Value, given, joined
from photonpano.specs.validation import unknown_key, validate
from photonpano.text import listed

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from pydantic import BaseModel

    from photonpano.errors import Problem
    from photonpano.registry import Catalog, Entry, Kind
    from photonpano.specs.auto import Found

VERSION = 1
LEVELS = 3
MAX_LEVELS = 8
UNTIL_CONVERGED = "until-converged"
"""Instead of a number of levels: as many as it takes, `MAX_LEVELS` at most."""
DEFAULTS = {"resample": "midpoint", "merge": "photon-mle", "locate": "direct", "interpolate": "smoothing-spline"}
"""The components of a spec that does not choose."""
DEFAULT_FALLBACK = "opencv-sift"
"""The locator to which lost pairs are offered, if it is installed and the spec names neither a locator nor fallbacks."""
KIND_OF = {kind.section: kind for kind in KINDS.values()}
"""The kind of component that a section chooses."""
SETTINGS: dict[str, type[BaseModel]] = {
    "graph": GraphSettings,
    "render": RenderSettings,
    "output": OutputSettings,
    "run": RunSettings,
}
"""The framework's own sections."""
SECTIONS = ("version", "source", "corrections", *STAGES, "levels", *SETTINGS)
"""All sections of a spec, in the order in which they are written."""


@dataclass(frozen=True, slots=True)
class _Selection:
    """What a section chooses: found in the catalog or not, its keys, the choice if all of it is right, and its fallbacks."""

    entry: Entry | None
    keys: Value
    choice: Choice | None
    fallbacks: tuple[Choice, ...] = ()


def resolve(root: Value, directory: Path, catalog: Catalog, problems: list[Problem]) -> Plan:
    """Make the plan of a spec.

    Args:
        root: the spec.
        directory: what relative paths count from.
        catalog: what can be chosen.
        problems: what reading the spec has found already.

    Raises:
        SpecError: with these problems and all others, in the order of the file.
    """
    unreadable = tuple(f"{where}." for where in root.unreadable())
    found: list[Problem] = []
    plan = _Resolver(root, directory, catalog, found).plan()
    problems += [problem for problem in found if not f"{problem.where}.".startswith(unreadable)]
    if plan is None or problems:
        raise SpecError(sorted(dict.fromkeys(problems), key=_order))
    return plan


def _order(problem: Problem) -> tuple[bool, int, int]:
    """Order by line; what concerns the whole file comes first, what an override brought in comes last."""
    return problem.file is None and problem.line is None, problem.line or 0, problem.column or 0


class _Resolver:
    """Resolves one spec; every method reports what it finds and goes on."""

    def __init__(self, root: Value, directory: Path, catalog: Catalog, problems: list[Problem]) -> None:
        self.root = root
        self.directory = directory
        self.catalog = catalog
        self.problems = problems
        self.places = root.places()
        self.recognised: Found | None = None

    def plan(self) -> Plan | None:
        """Resolve everything; None if there are problems."""
        written = self.mapping(self.root)
        if written is None:
            return None
        self.known_keys(written, SECTIONS)
        self.version(written.get("version"))
        sections = {name: written.get(name) or Value(None, replace(self.root.head, where=name)) for name in SECTIONS}
        source = self.select("source", sections["source"]).choice
        if source is not None:
            complained = list(map(sections["source"].head.problem, complaints(source)))
            self.problems += self.recognised.blamed(complained) if self.recognised else complained
        corrections = resolved_corrections(sections["corrections"], self.directory, self.problems)
        stages = {name: self.select(name, sections[name]) for name in STAGES}
        levels = [self.level(each, stages) for each in self.levels(sections["levels"])]
        until_converged = sections["levels"].content == UNTIL_CONVERGED
        settings: dict[str, Any] = {name: self.validated(model, sections[name]) for name, model in SETTINGS.items()}
        if source is None or self.problems:
            return None
        plan = Plan(
            source,
            corrections,
            tuple(filter(None, levels)),
            until_converged,
            **settings,
            document={},
            places=self.places,
            file=self.root.head.file,
            observers=self.catalog.observers,
            decisions=(self.recognised.decision,) if self.recognised else (),
        )
        return replace(plan, document=self.document(plan, stages))

    def version(self, value: Value | None) -> None:
        """Refuse a format that is not ours."""
        if value is None:
            self.problems.append(self.root.head.problem(f"required: {VERSION}, the version of the format", "version"))
        elif type(value.content) is not int or value.content != VERSION:
            got = given(value.content)
            self.problems.append(value.place.problem(f"expected {VERSION}, the version of the format, got {got}"))

    def select(self, section: str, value: Value, base: _Selection | None = None) -> _Selection:
        """Resolve a section that chooses a component.

        Args:
            section: such as "locate".
            value: what is written there.
            base: what a level goes on from: without `use`, it updates the keys of that.
        """
        kind = KIND_OF[section]
        content = self.mapping(value, " such as {use: NAME}")
        if content is None:
            return _Selection(None, value, None)
        keys = _keys(value, content)
        if base is not None and "use" not in content:
            entry, keys = base.entry, _updated(base, keys)
        else:
            default = Value(DEFAULTS[section], value.head) if section in DEFAULTS else None
            entry = self.entry(kind, value, content.get("use", default))
        known = ("use", "with", "fallback") if section == "locate" else ("use", "with")
        self.known_keys(content, known, entry.contribution.config.model_fields if entry else ())
        if entry is not None and entry.contribution is CHAIN:
            return self.chain(section, value, keys, base)
        if entry is not None and entry.contribution is AUTO:
            return self.auto(kind, value, content["use"], keys)
        choice = self.choice(entry, keys, base) if entry else None
        fallbacks = self.fallbacks(value, content, choice, base) if section == "locate" else ()
        return _Selection(entry, keys, choice, fallbacks)

    def chain(self, section: str, value: Value, keys: Value, base: _Selection | None) -> _Selection:
        """Resolve a section that uses the chain of locators: the first is chosen, and the others are its fallbacks."""
        spelled = spelled_out(value, keys, self.directory, self.problems)
        if spelled is None:
            return _Selection(None, keys, None)
        chosen, first = spelled
        self.remember(first, value.place.where)
        return self.select(section, chosen, base)

    def auto(self, kind: Kind, value: Value, use: Value, keys: Value) -> _Selection:
        """Resolve a section that leaves the source open: the one that recognises the path is chosen."""
        found = found_source(keys, self.catalog, self.directory, self.problems)
        if found is None:
            return _Selection(None, keys, None)
        self.recognised = found
        self.places = found.keys.places() | self.places
        before = len(self.problems)
        entry = self.entry(kind, value, replace(use, content=found.name))
        choice = self.choice(entry, found.keys, None) if entry else None
        self.problems[before:] = found.blamed(self.problems[before:])
        return _Selection(entry, found.keys, choice)

    def fallbacks(
        self, value: Value, content: dict[str, Value], first: Choice | None, base: _Selection | None
    ) -> tuple[Choice, ...]:
        """Resolve the locators to which lost pairs are offered: one or a list, each a name or a mapping.

        The default locator has a default fallback; one that is named has those that are named.

        Args:
            value: the section.
            content: its keys.
            first: the locator that the section chooses.
            base: what a level goes on from: it keeps the fallbacks of that, unless it names another locator or fallbacks.
        """
        again = "would lose the same pairs again"
        written = content.get("fallback")
        if written is None or written.content is None:
            if "use" in content:
                return ()
            if base is None:
                return self.default_fallbacks(value)
            if first is not None and first != base.choice and first in base.fallbacks:
                name = first.contribution.name
                self.problems.append(value.head.problem(f"the fallback {name!r} has the same keys, and {again}"))
            return base.fallbacks
        tried = [] if first is None else [first]
        found = []
        for index, item in enumerate(written.content if isinstance(written.content, list) else [written]):
            self.remember(item, joined(written.place.where, index))
            choice = self.fallback(item)
            if choice in tried:
                name = choice.contribution.name
                self.problems.append(item.head.problem(f"{name!r} with the same keys is tried before, and {again}"))
            elif choice is not None:
                tried.append(choice)
                found.append(choice)
        return tuple(found)

    def default_fallbacks(self, value: Value) -> tuple[Choice, ...]:
        """Resolve the fallback of a section that names neither a locator nor fallbacks."""
        if DEFAULT_FALLBACK not in self.catalog.names(KIND_OF["locate"].name):
            return ()
        place = replace(value.head, where=joined(value.head.where, "fallback"))
        choice = self.fallback(Value(DEFAULT_FALLBACK, place))
        return () if choice is None else (choice,)

    def fallback(self, item: Value) -> Choice | None:
        """Resolve one locator to which lost pairs are offered."""
        kind = KIND_OF["locate"]
        content = {"use": item} if isinstance(item.content, str) else item.content
        if not isinstance(content, dict):
            expected = "the name of a locator, or a mapping such as {use: NAME}"
            self.problems.append(item.place.problem(f"expected {expected}, got {given(item.content)}"))
            return None
        entry = self.entry(kind, item, content.get("use"))
        if entry is not None and entry.contribution is CHAIN:
            self.problems.append(item.head.problem(NO_PART))
            return None
        if nested := content.get("fallback"):
            message = "a fallback has none of its own; list all of them, in the order in which they are tried"
            self.problems.append(nested.head.problem(message))
        own = {key: value for key, value in content.items() if key != "fallback"}
        self.known_keys(own, ("use", "with"), entry.contribution.config.model_fields if entry else ())
        return self.choice(entry, _keys(item, content), None) if entry else None

    def remember(self, item: Value, where: str) -> None:
        """Remember where a fallback is written, by its path in the resolved spec, where it is a mapping in a list."""
        for each in item.walk():
            self.places[where + each.place.where.removeprefix(item.place.where)] = each.head
        if isinstance(item.content, str):
            self.places[joined(where, "use")] = item.head

    def choice(self, entry: Entry, keys: Value, base: _Selection | None) -> Choice | None:
        """Validate the keys of a component; what is wrong in the base of a level is not said again."""
        found: list[Problem] = []
        try:
            config = validate(entry.contribution.config, keys, self.directory, found)
            if config is not None:
                config.model_dump(mode="json")  # a run records it
        except Exception as error:
            found.append(keys.head.problem(f"the config of the {entry.label} raised {type(error).__name__}: {error}"))
            config = None
        if base is not None:
            said = {(each.where.removeprefix(base.keys.head.where), each.message) for each in self.problems}
            found = [each for each in found if (each.where.removeprefix(keys.head.where), each.message) not in said]
        self.problems += found
        return None if config is None else Choice(entry.contribution, config, entry.origin)

    def entry(self, kind: Kind, value: Value, use: Value | None) -> Entry | None:
        """Look up the component that a section names; None if it names none, or one that there is not."""
        if use is None:
            known = listed(name for name in self.catalog.names(kind.name) if name != CHAIN.name) or "none"
            self.problems.append(value.head.problem(f"required: the name of the {kind.name}; known: {known}", "use"))
            return None
        if not isinstance(use.content, str):
            self.problems.append(use.place.problem(f"expected the name of the {kind.name}, got {given(use.content)}"))
            return None
        try:
            entry = self.catalog.find(kind.name, use.content)
        except PluginError as error:
            self.problems.append(use.place.problem(str(error)))
            return None
        if entry.unavailable:
            self.problems.append(use.place.problem(entry.unavailable))
        return entry

    def levels(self, value: Value) -> list[Value]:
        """Return what is written for each level."""
        content = LEVELS if value.content is None else value.content
        if type(content) is int and 1 <= content <= MAX_LEVELS:
            return [Value({}, value.place)] * content
        if content == UNTIL_CONVERGED:
            return [Value({}, value.place)] * MAX_LEVELS
        if isinstance(content, list) and 1 <= len(content) <= MAX_LEVELS:
            return content
        expected = f"an integer from 1 to {MAX_LEVELS}, {UNTIL_CONVERGED}, or a list with an entry for each level"
        self.problems.append(value.place.problem(f"expected {expected}, got {given(value.content)}"))
        return []

    def level(self, value: Value, stages: dict[str, _Selection]) -> LevelPlan | None:
        """Resolve one level: the stages, as far as it does not say otherwise."""
        content = self.mapping(value)
        if content is None:
            return None
        own = {key: item for key, item in content.items() if key in LevelSettings.model_fields}
        self.known_keys(content, (*LevelSettings.model_fields, *STAGES))
        settings = self.validated(LevelSettings, Value(dict(own), value.place, value.key))
        selected = {
            name: self.select(name, content[name], stages[name]) if name in content else stages[name] for name in STAGES
        }
        choices: dict[str, Any] = {name: selection.choice for name, selection in selected.items()}
        if settings is None or None in choices.values():
            return None
        return LevelPlan(**choices, fallbacks=selected["locate"].fallbacks, scale=settings.scale)

    def document(self, plan: Plan, stages: dict[str, _Selection]) -> dict[str, Any]:
        """Write a plan down as plain data: every default is filled in, and a level has the stages in which it differs."""
        chosen = {name: _stage(name, stage.choice, stage.fallbacks) for name, stage in stages.items()}
        levels = []
        for level in plan.levels:
            own = {name: _stage(name, getattr(level, name), level.fallbacks) for name in STAGES}
            levels.append({"scale": level.scale} | {name: own[name] for name in STAGES if own[name] != chosen[name]})
        return {
            "version": VERSION,
            "source": _written(plan.source),
            "corrections": written_corrections(plan.corrections),
            **chosen,
            "levels": UNTIL_CONVERGED if plan.until_converged else levels,
            **{name: getattr(plan, name).model_dump(mode="json") for name in SETTINGS},
        }

    def mapping(self, value: Value, example: str = "") -> dict[str, Value] | None:
        """Return the keys of a section; null counts as an empty one, and None is returned for anything else."""
        if value.content is None:
            return {}
        if isinstance(value.content, dict):
            return value.content
        self.problems.append(value.place.problem(f"expected a mapping{example}, got {given(value.content)}"))
        return None

    def known_keys(self, content: dict[str, Value], known: Iterable[str], config: Iterable[str] = ()) -> None:
        """Report unknown keys; those of the component's config belong one storey down."""
        for key, value in content.items():
            if key not in known:
                message = "unknown key; it belongs under `with`" if key in config else unknown_key(key, known)
                self.problems.append(value.head.problem(message))

    def validated(self, model: type[BaseModel], value: Value) -> Any:
        """Validate a section; None if it has problems."""
        return validate(model, value, self.directory, self.problems)


def _keys(value: Value, content: dict[str, Value]) -> Value:
    """Return the keys of a component; where there are none, an empty mapping where they would stand."""
    here = replace(value.head, where=joined(value.head.where, "with"))
    return content.get("with") or Value({}, here, here)


def _updated(base: _Selection, keys: Value) -> Value:
    """Lay keys over those of the base."""
    if not isinstance(keys.content, dict) or not isinstance(base.keys.content, dict):
        return base.keys if keys.content is None else keys
    return Value(base.keys.content | keys.content, keys.place, keys.key)


def _stage(name: str, choice: Any, fallbacks: Iterable[Choice]) -> dict[str, Any]:
    return _written(choice) | ({"fallback": [_written(each) for each in fallbacks]} if name == "locate" else {})


def _written(choice: Choice) -> dict[str, Any]:
    return {"use": choice.contribution.name, "with": choice.config.model_dump(mode="json", by_alias=True)}
