"""Resolve a spec against a catalog: to a plan, written down with all defaults, or to all of its problems."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from photonpano.errors import SpecError
from photonpano.plugins.contributions import KINDS, RunKindContribution
from photonpano.specs.builtin import check_flat_field, check_settings, complaints
from photonpano.specs.components import AUTO, ComponentResolver, Stage, resolved_corrections, written_corrections
from photonpano.specs.plan import Choice, LevelPlan, Plan, Spec, validate
from photonpano.specs.settings import (
    CHOICE,
    LEVELS,
    MAX_LEVELS,
    NOT_SETTINGS,
    PANORAMA_ONLY,
    SETTINGS,
    STAGES,
    UNTIL_CONVERGED,
    VERSION,
    LevelSettings,
)
from photonpano.specs.yaml_reader import Written, given


def resolve(spec: Spec) -> Plan:
    """Make the plan of a spec; `SpecError` with all problems, in the order of the file, also those from reading it."""
    root = spec.mapping(spec.root)
    plan = None if root is None else _Resolver(root, spec).plan()
    if plan is None or spec.problems:
        # Those of the whole file come first, those of overrides last.
        places = {each: (each.file is None and each.line is None, each.line or 0, each.column or 0) for each in spec.problems}
        raise SpecError(sorted(places, key=lambda each: places[each]))
    return plan


class _Resolver:
    """Resolves one spec; every method adds the problems that it finds to the spec, and goes on."""

    def __init__(self, root: Written, spec: Spec) -> None:
        self.root = spec.root = root if spec.kind is None else _without_panorama(root, spec, spec.kind)
        self.spec = spec
        self.components = ComponentResolver(spec)

    def plan(self) -> Plan | None:
        """Resolve every section; None if there are problems."""
        spec, root, components = self.spec, self.root, self.components
        run_kind = spec.kind
        spec.check_keys(root, spec.sections)
        version = root.at("version")
        if "version" not in root.data:
            spec.wrong_key(version, f"required: {VERSION}, the version of the format")
        elif type(version.data) is not int or version.data != VERSION:
            spec.wrong(version, f"expected {VERSION}, the version of the format, got {given(version.data)}")
        source = components.stage(KINDS["source"], root.at("source"))
        for complaint in complaints(source.choice) if source.choice and not spec.arriving else ():
            spec.wrong_key(root.at("source"), complaint)
        spec.remark = ""
        corrections = resolved_corrections(root.at("corrections"), spec)
        stages = {kind.section: components.stage(kind, root.at(kind.section)) for kind in KINDS.values() if kind.of_level}
        refine = components.items(KINDS["refiner"], root.at("refine"), KINDS["refiner"].default)
        refiners = [components.item(KINDS["refiner"], item) for item in refine]
        levels = [self.level(level, stages) for level in self.levels()]
        plans = [plan for _, plan in levels if plan is not None]
        renderer = self.renderer()
        formats = components.items(KINDS["exporter"], root.at("output", "formats"))
        exporters = components.formats(formats)
        executor = root.at("run", "executor").spelled_out()
        works = None if executor.data is None else components.item(KINDS["executor"], executor)
        of_kind, finder = {}, None
        if run_kind is not None:
            found = root.at(run_kind.section).spelled_out()
            of_kind[run_kind.section] = found
            finder = components.item(KINDS[run_kind.component.kind], found.having({}) if found.data is None else found)
        written = root.having({"light": root.at("light").spelled_out("mode")})
        settings: dict[str, Any] = {
            name: validate(model, written.at(name).without(*NOT_SETTINGS.get(name, ())), spec)
            for name, model in SETTINGS.items()
        }
        check_settings(settings, spec)
        check_flat_field(corrections or (), plans, spec)
        if source.choice is None or renderer is None or (run_kind is not None and finder is None) or spec.problems:
            return None
        spelled_out = stages | {"source": source}
        sections = {name: stage.section for name, stage in spelled_out.items() if stage.section} | {
            "refine": Written(refine, root.at("refine").place),
            "levels": Written([level for level, _ in levels], root.at("levels").place),
            "output": written.at("output").having({"formats": Written(formats, root.at("output", "formats").place)}),
            "run": written.at("run").having({"executor": executor}),
            **of_kind,
        }
        plan = Plan(
            source=source.choice,
            corrections=corrections or (),
            levels=() if run_kind else tuple(plans),
            refine=() if run_kind else tuple(filter(None, refiners)),
            renderer=renderer,
            formats=exporters,
            executor=works,
            until_converged=root.at("levels").data == UNTIL_CONVERGED,
            **settings,
            document={},
            written=written.having(sections),
            file=root.place.file,
            observers=spec.catalog.observers,
            recognised=spec.recognised,
            corrects_itself=corrections is None,
            kind=run_kind,
            finder=finder,
        )
        return replace(plan, document=document_of(plan, stages))

    def renderer(self) -> Choice | None:
        """Resolve the component that `render` chooses, whose keys `use` and `with` stand beside the framework's."""
        kind, section = KINDS["renderer"], self.root.at("render").only(CHOICE)
        if section.data is not None and not isinstance(section.data, dict):
            return None  # reported with the settings of the section
        default = Written({"use": Written(kind.default, section.place.below("use"))}, section.place)
        return self.components.component(kind, section.laid_over(default))

    def levels(self) -> list[Written]:
        """Return what is written for each level."""
        levels = self.root.at("levels")
        number = MAX_LEVELS if levels.data == UNTIL_CONVERGED else LEVELS if levels.data is None else levels.data
        if type(number) is int and 1 <= number <= MAX_LEVELS:
            return [Written({}, levels.place.below(index)) for index in range(number)]
        if isinstance(levels.data, list) and 1 <= len(levels.data) <= MAX_LEVELS:
            return levels.data
        expected = f"an integer from 1 to {MAX_LEVELS}, {UNTIL_CONVERGED}, or a list with an entry for each level"
        self.spec.wrong(levels, f"expected {expected}, got {given(levels.data)}")
        return []

    def level(self, written: Written, stages: dict[str, Stage]) -> tuple[Written, LevelPlan | None]:
        """Resolve one level: the stages, as far as it does not override them.

        Returns the level with the sections that it overrides spelled out, and its plan; None for a level with problems.
        """
        content = self.spec.mapping(written)
        if content is None:
            return written, None
        self.spec.check_keys(content, (*LevelSettings.model_fields, *STAGES))
        settings = validate(LevelSettings, content.only(LevelSettings.model_fields), self.spec)
        own = {
            kind.section: self.components.stage(kind, content.at(kind.section), stages[kind.section])
            for kind in KINDS.values()
            if kind.section in content.data and kind.of_level
        }
        selected = stages | own
        choices: dict[str, Any] = {name: stage.choice for name, stage in selected.items()}
        spelled_out = content.having({name: stage.section for name, stage in own.items() if stage.section})
        if settings is None or None in choices.values():
            return spelled_out, None
        return spelled_out, LevelPlan(**choices, fallbacks=selected["locate"].fallbacks, scale=settings.scale)


def _without_panorama(root: Written, spec: Spec, kind: RunKindContribution) -> Written:
    """Refuse the sections that do not apply to a kind of run without a panorama, and return the others."""
    without = f"does not apply with `{kind.section}`"
    for key in PANORAMA_ONLY:
        if key in root.data:
            message = f"{without}, which finds {kind.name} instead of a panorama; remove it, or remove `{kind.section}`"
            spec.wrong_key(root.at(key), message)
    keys = {
        ("output", "formats"): f"there is no panorama to write; {kind.name} are written in all their formats",
        ("output", "keep"): "exposures and halves are those of a panorama; remove it, or write exposures: true",
        ("run", "executor"): f"{kind.name} are found in threads of one process",
        ("run", "time_limit"): f"a {kind.component.kind.replace('-', ' ')} cannot end early; remove it",
    }
    for path, why in keys.items():
        if root.at(*path).data is not None:
            spec.wrong_key(root.at(*path), f"{without}: {why}")
    own = root.without(*PANORAMA_ONLY)
    return own.having({"output": own.at("output").without("formats")}) if "output" in own.data else own


def document_of(plan: Plan, stages: Mapping[str, Stage]) -> dict[str, Any]:
    """Return a plan as plain data, which is a spec itself; `stages` are those of levels that override nothing."""
    chosen = {name: _stage(name, stage.choice, stage.fallbacks) for name, stage in stages.items()}
    document = {
        "version": VERSION,
        "source": _component(plan.source),
        "corrections": AUTO if plan.corrects_itself else written_corrections(plan.corrections),
        **chosen,
        "refine": [_component(refiner) for refiner in plan.refine],
        "levels": UNTIL_CONVERGED if plan.until_converged else [_level(level, chosen) for level in plan.levels],
        **({} if plan.kind is None or plan.finder is None else {plan.kind.section: _component(plan.finder)}),
        **{name: getattr(plan, name).model_dump(mode="json") for name in SETTINGS},
    }
    document["render"] = _component(plan.renderer) | document["render"]
    document["run"] |= {} if plan.executor is None else {"executor": _component(plan.executor)}
    document["output"] |= {"formats": [_component(each) for each in plan.formats]}
    inapplicable = ("exposures",) if plan.kind is None else ("formats", "keep")
    document["output"] = {key: value for key, value in document["output"].items() if key not in inapplicable}
    return document if plan.kind is None else {key: document[key] for key in document if key not in PANORAMA_ONLY}


def _stage(name: str, choice: Any, fallbacks: Iterable[Choice]) -> dict[str, Any]:
    return _component(choice) | ({"fallback": [_component(each) for each in fallbacks]} if name == "locate" else {})


def _component(choice: Choice) -> dict[str, Any]:
    return {"use": choice.contribution.name, "with": choice.config.model_dump(mode="json", by_alias=True)}


def _level(level: LevelPlan, chosen: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Write a level down: its scale, and the stages in which it differs."""
    own = {name: _stage(name, getattr(level, name), level.fallbacks) for name in STAGES}
    return {"scale": level.scale} | {name: own[name] for name in STAGES if own[name] != chosen[name]}
