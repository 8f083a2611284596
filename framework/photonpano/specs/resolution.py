"""Resolve a spec against a catalog: to a plan, or to all of its problems."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from photonpano.errors import SpecError
from photonpano.specs.checks import STAGES, complaints
from photonpano.specs.components import CHOICE, DEFAULT_REFINER, DEFAULTS, KIND_OF, ComponentResolver, Stage, written_formats
from photonpano.specs.corrections import AUTO, check_flat_field, resolved_corrections, written_corrections
from photonpano.specs.plan import Choice, LevelPlan, Plan
from photonpano.specs.pose import check_posed_camera, document_of_poses, without_panorama
from photonpano.specs.settings import (
    CameraSettings,
    GraphSettings,
    LevelSettings,
    LightSettings,
    MotionSettings,
    OutputSettings,
    RenderSettings,
    RunSettings,
)
from photonpano.specs.validation import validate
from photonpano.specs.written import WrittenSpec, given

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pydantic import BaseModel

    from photonpano.errors import Problem

VERSION = 1
LEVELS = 3
MAX_LEVELS = 8
UNTIL_CONVERGED = "until-converged"
"""Instead of a number of levels: as many as the motion needs to converge, `MAX_LEVELS` at most."""
SETTINGS: dict[str, type[BaseModel]] = {
    "motion": MotionSettings,
    "camera": CameraSettings,
    "light": LightSettings,
    "graph": GraphSettings,
    "render": RenderSettings,
    "output": OutputSettings,
    "run": RunSettings,
}
"""The framework's own sections."""
SECTIONS = ("version", "source", "corrections", *STAGES, "refine", "levels", "pose", *SETTINGS)
"""All sections of a spec, in the order in which they are written."""


def resolve(spec: WrittenSpec) -> Plan:
    """Make the plan of a spec.

    Args:
        spec: the spec, with the problems that reading it has found.

    Raises:
        SpecError: with all problems, in the order of the file.
    """
    problems, spec.problems = spec.problems, []
    plan = _Resolver(spec).plan()
    unreadable = tuple(f"{where}." for where in spec.unreadable)
    problems += [problem for problem in spec.problems if not f"{problem.where}.".startswith(unreadable)]
    if plan is None or problems:
        raise SpecError(sorted(dict.fromkeys(problems), key=_order))
    return plan


def _order(problem: Problem) -> tuple[bool, int, int]:
    """Order problems by line; those of the whole file come first, those of overrides last."""
    return problem.file is None and problem.line is None, problem.line or 0, problem.column or 0


class _Resolver:
    """Resolves one spec; every method reports the problems that it finds and goes on."""

    def __init__(self, spec: WrittenSpec) -> None:
        self.spec = spec
        self.components = ComponentResolver(spec)

    def plan(self) -> Plan | None:
        """Resolve everything; None if there are problems."""
        spec = self.spec
        root = spec.mapping(spec.data, "")
        if root is None:
            return None
        if posed := "pose" in root:
            root = without_panorama(root, spec)
        refiners = self.components.items(KIND_OF["refine"], root.get("refine"), "refine", DEFAULT_REFINER)
        spec.sections_of = self.sections_of(root, refiners)
        spec.check_keys(root, "", SECTIONS)
        self.check_version(root)
        source = self.components.stage("source", root.get("source"), "source").choice
        for complaint in complaints(source) if source and not spec.arriving else ():
            spec.wrong_key("source", complaint)
        spec.remark = ""
        spec.places = {name: spec.place(name) for name in STAGES} | spec.places
        corrections = resolved_corrections(root.get("corrections"), spec)
        stages = {name: self.components.stage(name, root.get(name), name) for name in STAGES}
        refine = [self.components.item(KIND_OF["refine"], item, f"refine.{index}") for index, item in enumerate(refiners)]
        written = self.levels(root.get("levels"))
        levels = [self.level(data, f"levels.{index}", stages) for index, data in enumerate(written)]
        renderer = self.components.renderer(root.get("render"))
        formats = self.components.formats(written_formats(root))
        executor = self.components.executor(root.get("run"))
        pose = self.components.item(KIND_OF["pose"], {} if root["pose"] is None else root["pose"], "pose") if posed else None
        self.spell_out_light(root)
        settings = self.settings(root, posed)
        mergers = [level.merge.contribution for level in levels if level]
        check_flat_field(corrections or (), mergers, posed, spec)
        if source is None or renderer is None or (posed and pose is None) or spec.problems:
            return None
        plan = Plan(
            source,
            corrections or (),
            () if posed else tuple(filter(None, levels)),
            () if posed else tuple(filter(None, refine)),
            renderer,
            formats,
            executor,
            root.get("levels") == UNTIL_CONVERGED,
            **settings,
            document={},
            places=spec.places,
            file=spec.place("").file,
            observers=spec.catalog.observers,
            decisions=tuple(spec.decisions),
            corrects_itself=corrections is None,
            pose=pose,
        )
        return replace(plan, document=_document(plan, stages))

    def check_version(self, root: dict[str, Any]) -> None:
        """Refuse a spec of another format."""
        if "version" not in root:
            self.spec.wrong_key("version", f"required: {VERSION}, the version of the format")
        elif type(root["version"]) is not int or root["version"] != VERSION:
            self.spec.wrong("version", f"expected {VERSION}, the version of the format, got {given(root['version'])}")

    def settings(self, root: dict[str, Any], posed: bool) -> dict[str, Any]:
        """Validate the framework's own sections, and what they say together; None for a section with problems."""
        found: dict[str, Any] = {
            name: validate(model, _settings(name, root.get(name)), name, self.spec) for name, model in SETTINGS.items()
        }
        motion, camera, output, render = (found[name] for name in ("motion", "camera", "output", "render"))
        if motion is not None and camera is not None:
            if posed:
                check_posed_camera(camera, self.spec)
            else:
                self.check_camera(motion, camera)
        if not posed and output is not None and output.exposures:
            message = "true needs a section `pose`: a panorama has no exposures with poses; remove it"
            self.spec.wrong("output.exposures", message)
        if posed and output is not None and output.keep is not None:
            message = "exposures are those of the levels of a panorama; remove it, or write exposures: true"
            self.spec.wrong("output.keep", message)
        if motion is not None and render is not None:
            self.check_projection(motion, render)
        return found

    def check_camera(self, motion: MotionSettings, camera: CameraSettings) -> None:
        """Refuse what the model homography cannot find, as it knows no camera, and a start that only it can have."""
        if motion.start != "none" and motion.model != "homography":
            message = f"{motion.start} is the start of motion.model: homography, not of {motion.model}"
            self.spec.wrong("motion.start", message)
        if motion.model != "homography":
            return
        distortion = camera.distortion.model_dump()
        for key in (key for key, number in distortion.items() if number == "find"):
            message = "find needs motion.model: rotation or auto, which measure the camera; give a number here"
            self.spec.wrong(f"camera.distortion.{key}", message)
        if camera.focal_px == "find" and any(distortion.values()):
            message = "distortion is in units of the focal length: give camera.focal_px, or take motion.model: rotation"
            self.spec.wrong_key("camera.distortion", message)

    def check_projection(self, motion: MotionSettings, render: RenderSettings) -> None:
        """Refuse a cylinder or a sphere of homographies, which have no directions."""
        if motion.model == "homography" and render.projection not in ("auto", "planar"):
            message = f"a {render.projection} panorama needs motion.model: rotation or auto; one of homographies is planar"
            self.spec.wrong("render.projection", message)

    def spell_out_light(self, root: dict[str, Any]) -> None:
        """Replace a word in the section `light` by the mapping that it stands for."""
        if isinstance(root.get("light"), str):
            root["light"] = {"mode": root["light"]}
            if "light" in self.spec.places:
                self.spec.places = {"light.mode": self.spec.places["light"]} | self.spec.places

    def sections_of(self, root: dict[str, Any], refiners: list[Any]) -> dict[str, list[str]]:
        """Return the sections in which each key may stand, for the components that the spec chooses."""
        with_component = ("source", *STAGES, "render", "pose")
        keys_of = self.components.keys_of
        keys = {f"{name}.with": keys_of(KIND_OF[name], _name(name, root.get(name))) for name in with_component}
        for index, item in enumerate(refiners):
            where = f"refine.{index}.with" if isinstance(root.get("refine"), list) else "refine.with"
            keys[where] = keys_of(KIND_OF["refine"], _name("refine", {"use": item} if isinstance(item, str) else item))
        keys |= {
            f"output.formats.{index}.with": keys_of(KIND_OF["output.formats"], item.get("use"))
            for index, item in enumerate(_as_list(written_formats(root)))
            if isinstance(item, dict)
        }
        if isinstance(root.get("run"), dict) and isinstance(root["run"].get("executor"), dict):
            keys["run.executor.with"] = keys_of(KIND_OF["run.executor"], root["run"]["executor"].get("use"))
        keys |= {name: model.model_fields for name, model in SETTINGS.items()} | {"locate": ("fallback",)}
        found = {name: [""] for name in SECTIONS}
        for section, own in keys.items():
            for key in own:
                found.setdefault(key, []).append(section)
        return found

    def levels(self, data: Any) -> list[Any]:
        """Return what is written for each level."""
        number = MAX_LEVELS if data == UNTIL_CONVERGED else LEVELS if data is None else data
        if type(number) is int and 1 <= number <= MAX_LEVELS:
            return [{}] * number
        if isinstance(data, list) and 1 <= len(data) <= MAX_LEVELS:
            return data
        expected = f"an integer from 1 to {MAX_LEVELS}, {UNTIL_CONVERGED}, or a list with an entry for each level"
        self.spec.wrong("levels", f"expected {expected}, got {given(data)}")
        return []

    def level(self, data: Any, where: str, stages: dict[str, Stage]) -> LevelPlan | None:
        """Resolve one level: the stages, as far as it does not override them."""
        content = self.spec.mapping(data, where)
        if content is None:
            return None
        self.spec.check_keys(content, where, (*LevelSettings.model_fields, *STAGES))
        own = {key: value for key, value in content.items() if key in LevelSettings.model_fields}
        settings = validate(LevelSettings, own, where, self.spec)
        selected = dict(stages)
        for name in STAGES:
            if name in content:
                selected[name] = self.components.stage(name, content[name], f"{where}.{name}", stages[name])
            else:
                self.spec.places = self.spec.places_under(name, f"{where}.{name}") | self.spec.places
        choices: dict[str, Any] = {name: stage.choice for name, stage in selected.items()}
        if settings is None or None in choices.values():
            return None
        return LevelPlan(**choices, fallbacks=selected["locate"].fallbacks, scale=settings.scale)


def _document(plan: Plan, stages: dict[str, Stage]) -> dict[str, Any]:
    """Write a plan down as a spec, defaults filled in; `stages` are those that levels do not override."""
    chosen = {name: _stage(name, stage.choice, stage.fallbacks) for name, stage in stages.items()}
    document = {
        "version": VERSION,
        "source": _component(plan.source),
        "corrections": AUTO if plan.corrects_itself else written_corrections(plan.corrections),
        **chosen,
        "refine": [_component(refiner) for refiner in plan.refine],
        "levels": UNTIL_CONVERGED if plan.until_converged else [_level(level, chosen) for level in plan.levels],
        **({} if plan.pose is None else {"pose": _component(plan.pose)}),
        **{name: getattr(plan, name).model_dump(mode="json") for name in SETTINGS},
    }
    document["render"] = _component(plan.renderer) | document["render"]
    document["run"] |= {} if plan.executor is None else {"executor": _component(plan.executor)}
    document["output"] |= {"formats": [_component(each) for each in plan.formats]}
    if plan.pose is not None:
        return document_of_poses(document)
    del document["output"]["exposures"]
    return document


def _settings(name: str, data: Any) -> Any:
    """Return the framework's own keys of a section, without those that choose components."""
    others = {"render": CHOICE, "output": ("formats",), "run": ("executor",)}.get(name, ())
    return {key: value for key, value in data.items() if key not in others} if isinstance(data, dict) else data


def _as_list(data: Any) -> list[Any]:
    return data if isinstance(data, list) else [data]


def _name(section: str, data: Any) -> object:
    """Return the name of the component that a section chooses."""
    default = DEFAULTS.get(section)
    return data.get("use", default) if isinstance(data, dict) else default


def _stage(name: str, choice: Any, fallbacks: Iterable[Choice]) -> dict[str, Any]:
    return _component(choice) | ({"fallback": [_component(each) for each in fallbacks]} if name == "locate" else {})


def _component(choice: Choice) -> dict[str, Any]:
    return {"use": choice.contribution.name, "with": choice.config.model_dump(mode="json", by_alias=True)}


def _level(level: LevelPlan, chosen: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Write a level down: its scale, and the stages in which it differs."""
    own = {name: _stage(name, getattr(level, name), level.fallbacks) for name in STAGES}
    return {"scale": level.scale} | {name: own[name] for name in STAGES if own[name] != chosen[name]}
