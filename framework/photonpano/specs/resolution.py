"""Resolve a spec against a catalog: to a plan, or to all of its problems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from photonpano.contributions import ExporterContribution
from photonpano.errors import PluginError, SpecError, described
from photonpano.interrupts import is_interrupt
from photonpano.registry.kinds import KINDS
from photonpano.specs.aliases import Alias
from photonpano.specs.checks import STAGES, complaints
from photonpano.specs.corrections import AUTO, resolved_corrections, written_corrections
from photonpano.specs.plan import Choice, LevelPlan, Plan
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
from photonpano.text import listed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pydantic import BaseModel

    from photonpano.errors import Problem
    from photonpano.registry import Entry, Kind

VERSION = 1
LEVELS = 3
MAX_LEVELS = 8
UNTIL_CONVERGED = "until-converged"
"""Instead of a number of levels: as many as the motion needs to converge, `MAX_LEVELS` at most."""
DEFAULTS = {
    "resample": "midpoint",
    "merge": "photon-mle",
    "locate": "direct",
    "interpolate": "smoothing-spline",
    "render": "merge",
}
"""The components that a spec uses by default."""
DEFAULT_FALLBACK = "opencv-sift"
"""The locator to which lost pairs are offered, if it is installed and the spec names neither a locator nor fallbacks."""
DEFAULT_REFINER = "short-spans"
"""The refiner that corrects the motion, if it is installed and the spec names none."""
KIND_OF = {kind.section: kind for kind in KINDS.values()}
"""The kind of component that a section chooses."""
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
MAX_LISTED = 16
"""The largest number of components in a list, such as fallbacks."""
SECTIONS = ("version", "source", "corrections", *STAGES, "refine", "levels", "pose", *SETTINGS)
"""All sections of a spec, in the order in which they are written."""
PANORAMA_ONLY = (*STAGES, "refine", "levels", "motion", "light", "graph", "render")
"""The sections that do not apply with `pose`."""
_CHOICE = ("use", "with")
"""The keys that choose a component."""
_AGAIN = "would lose the same pairs again"


@dataclass(frozen=True, slots=True)
class _Stage:
    """A section that chooses a component.

    Attributes:
        section: its keys `use`, `with` and `fallback`, with aliases and defaults spelled out; None if they cannot be.
        choice: the component; None if there are problems.
        fallbacks: the locators to which lost pairs are offered.
    """

    section: dict[str, Any] | None = None
    choice: Choice | None = None
    fallbacks: tuple[Choice, ...] = ()


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
        self.catalog = spec.catalog

    def plan(self) -> Plan | None:
        """Resolve everything; None if there are problems."""
        spec = self.spec
        root = spec.mapping(spec.data, "")
        if root is None:
            return None
        if posed := "pose" in root:
            root = self.without_panorama(root)
        refiners = self.items(KIND_OF["refine"], root.get("refine"), "refine", DEFAULT_REFINER)
        spec.sections_of = self.sections_of(root, refiners)
        spec.check_keys(root, "", SECTIONS)
        if "version" not in root:
            spec.wrong_key("version", f"required: {VERSION}, the version of the format")
        elif type(root["version"]) is not int or root["version"] != VERSION:
            spec.wrong("version", f"expected {VERSION}, the version of the format, got {given(root['version'])}")
        source = self.stage("source", root.get("source"), "source").choice
        for complaint in complaints(source) if source else ():
            spec.wrong_key("source", complaint)
        spec.remark = ""
        spec.places = {name: spec.place(name) for name in STAGES} | spec.places
        corrections = resolved_corrections(root.get("corrections"), spec)
        stages = {name: self.stage(name, root.get(name), name) for name in STAGES}
        refine = [self.item(KIND_OF["refine"], item, f"refine.{index}") for index, item in enumerate(refiners)]
        written = self.levels(root.get("levels"))
        levels = [self.level(data, f"levels.{index}", stages) for index, data in enumerate(written)]
        renderer = self.renderer(root.get("render"))
        formats = self.formats(_written_formats(root))
        pose = self.pose(root["pose"]) if posed else None
        self.spell_out_light(root)
        settings: dict[str, Any] = {
            name: validate(model, _settings(name, root.get(name)), name, spec) for name, model in SETTINGS.items()
        }
        if isinstance(settings["motion"], MotionSettings) and isinstance(settings["camera"], CameraSettings):
            self.check_camera(None if posed else settings["motion"], settings["camera"])
        if not posed and isinstance(settings["output"], OutputSettings) and settings["output"].exposures:
            spec.wrong("output.exposures", "true needs a section `pose`: a panorama has no exposures with poses; remove it")
        if isinstance(settings["motion"], MotionSettings) and isinstance(settings["render"], RenderSettings):
            self.check_projection(settings["motion"], settings["render"])
        if source is None or renderer is None or (posed and pose is None) or spec.problems:
            return None
        until_converged = root.get("levels") == UNTIL_CONVERGED
        chosen = {name: _stage(name, stage.choice, stage.fallbacks) for name, stage in stages.items()}
        document = {
            "version": VERSION,
            "source": _component(source),
            "corrections": AUTO if corrections is None else written_corrections(corrections),
            **chosen,
            "refine": [_component(refiner) for refiner in refine if refiner],
            "levels": UNTIL_CONVERGED if until_converged else [_level(level, chosen) for level in levels if level],
            **({} if pose is None else {"pose": _component(pose)}),
            **{name: section.model_dump(mode="json") for name, section in settings.items()},
        }
        document["render"] = _component(renderer) | document["render"]
        document["output"] |= {"formats": [_component(each) for each in formats]}
        if pose is not None:
            document = {key: value for key, value in document.items() if key not in PANORAMA_ONLY}
            del document["output"]["formats"]
        else:
            del document["output"]["exposures"]
        return Plan(
            source,
            corrections or (),
            () if posed else tuple(filter(None, levels)),
            () if posed else tuple(filter(None, refine)),
            renderer,
            formats,
            until_converged,
            **settings,
            document=document,
            places=spec.places,
            file=spec.place("").file,
            observers=self.catalog.observers,
            decisions=tuple(spec.decisions),
            corrects_itself=corrections is None,
            pose=pose,
        )

    def without_panorama(self, root: dict[str, Any]) -> dict[str, Any]:
        """Refuse the sections that do not apply with `pose`, and return the others."""
        for key in PANORAMA_ONLY:
            if key in root:
                message = "does not apply with `pose`, which finds poses instead of a panorama; remove it, or remove `pose`"
                self.spec.wrong_key(key, message)
        if _written_formats(root) is not None:
            message = "does not apply with `pose`: there is no panorama to write; `photonpano export` writes poses"
            self.spec.wrong_key("output.formats", message)
        own = {key: value for key, value in root.items() if key not in PANORAMA_ONLY}
        output = own.get("output")
        if isinstance(output, dict):
            own["output"] = {key: value for key, value in output.items() if key != "formats"}
        return own

    def pose(self, data: Any) -> Choice | None:
        """Resolve the pose estimator, which is a name or a mapping."""
        content = {} if data is None else data
        return self.item(KIND_OF["pose"], content, "pose")

    def check_camera(self, motion: MotionSettings | None, camera: CameraSettings) -> None:
        """Refuse what the model homography cannot find, as it knows no camera, and what pose estimators (no motion) cannot."""
        if motion is None:
            return self.check_posed_camera(camera)
        if motion.model != "homography":
            return None
        distortion = camera.distortion.model_dump()
        for key in (key for key, number in distortion.items() if number == "find"):
            message = "find needs motion.model: rotation or auto, which measure the camera; give a number here"
            self.spec.wrong(f"camera.distortion.{key}", message)
        if camera.focal_px == "find" and any(distortion.values()):
            message = "distortion is in units of the focal length: give camera.focal_px, or take motion.model: rotation"
            self.spec.wrong_key("camera.distortion", message)
        return None

    def check_posed_camera(self, camera: CameraSettings) -> None:
        """Refuse a distortion that is to be found: pose estimators take it as it is given."""
        distortion = camera.distortion.model_dump()
        for key in (key for key, number in distortion.items() if number == "find"):
            message = "find does not apply with `pose`: calibrate the lens, or measure it in a run with motion.model: rotation"
            self.spec.wrong(f"camera.distortion.{key}", message)
        if camera.focal_px == "find" and any(number not in (0, "find") for number in distortion.values()):
            message = "distortion is in units of the focal length: give camera.focal_px"
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
        keys = {f"{name}.with": self.keys_of(KIND_OF[name], _name(name, root.get(name))) for name in with_component}
        for index, item in enumerate(refiners):
            where = f"refine.{index}.with" if isinstance(root.get("refine"), list) else "refine.with"
            keys[where] = self.keys_of(KIND_OF["refine"], _name("refine", {"use": item} if isinstance(item, str) else item))
        keys |= {
            f"output.formats.{index}.with": self.keys_of(KIND_OF["output.formats"], item.get("use"))
            for index, item in enumerate(_as_list(_written_formats(root)))
            if isinstance(item, dict)
        }
        keys |= {name: model.model_fields for name, model in SETTINGS.items()} | {"locate": ("fallback",)}
        found = {name: [""] for name in SECTIONS}
        for section, own in keys.items():
            for key in own:
                found.setdefault(key, []).append(section)
        return found

    def stage(self, name: str, data: Any, where: str, base: _Stage | None = None) -> _Stage:
        """Resolve a section that chooses a component.

        Args:
            name: such as "locate".
            data: the section.
            where: its path.
            base: for a section of a level, that of all levels: without `use`, the section updates the keys of this.
        """
        spec = self.spec
        content = spec.mapping(data, where, " such as {use: NAME}")
        if content is None:
            return _Stage()
        if "use" in content:
            base = None
        section = self.spelled_out(name, content, where, base)
        if section is None:
            return _Stage()
        n_problems = len(spec.problems)
        choice = self.component(KIND_OF[name], section, where)
        fallbacks = self.fallbacks(section["fallback"], where, choice) if name == "locate" else ()
        if base is not None:  # a problem of the base is reported again only for a key that the level itself writes
            old, new = spec.problems[:n_problems], spec.problems[n_problems:]
            reported = {(each.where.removeprefix(name), each.message) for each in old}
            own = spec.places.keys() - {f"{where}.with"}
            spec.problems = old + [x for x in new if x.where in own or (x.where.removeprefix(where), x.message) not in reported]
        return _Stage(section, choice, fallbacks)

    def renderer(self, data: Any) -> Choice | None:
        """Resolve the component that `render` chooses, whose keys `use` and `with` stand beside the framework's."""
        if data is not None and not isinstance(data, dict):
            return None  # reported with the settings of the section
        chosen = {"use": DEFAULTS["render"]} | {key: value for key, value in (data or {}).items() if key in _CHOICE}
        return self.component(KIND_OF["render"], chosen, "render")

    def formats(self, data: Any) -> tuple[Choice, ...]:
        """Resolve the exporters; two of them cannot write the same file."""
        where, found = "output.formats", dict[str, Choice]()
        for index, item in enumerate(self.items(KIND_OF[where], data, where, None)):
            choice = self.item(KIND_OF[where], item, f"{where}.{index}")
            if choice is None:
                continue
            assert isinstance(choice.contribution, ExporterContribution)
            name, suffix = choice.contribution.name, choice.contribution.suffix
            if suffix in found:
                other = found[suffix].contribution.name
                self.spec.wrong_key(
                    f"{where}.{index}", f"{name!r} writes panorama{suffix}, as {other!r} does; keep one of them"
                )
            found.setdefault(suffix, choice)
        return tuple(found.values())

    def spelled_out(self, name: str, content: dict[str, Any], where: str, base: _Stage | None) -> dict[str, Any] | None:
        """Return a section with inherited keys, defaults and aliases filled in, and a list of fallbacks; None if that fails."""
        spec, kind = self.spec, KIND_OF[name]
        section = dict(content)
        if base is not None:
            if base.section is None:
                return None
            own = {key: value for key, value in content.items() if value is not None}
            section = base.section | own | {"with": _updated(base.section.get("with"), content.get("with"))}
            for key in {"use", "with", "fallback"} - (own.keys() - {"with"}):
                spec.places = spec.places_under(f"{name}.{key}", f"{where}.{key}") | spec.places
        elif "use" not in content and name in DEFAULTS:
            section["use"] = DEFAULTS[name]
        known = ("use", "with", "fallback") if name == "locate" else ("use", "with")
        spec.check_keys(content, where, known, below=self.keys_of(kind, section.get("use")))
        if alias := self.alias(kind, section.get("use")):
            expanded = alias.expand(section, where, spec)
            if expanded is None:
                return None
            section = expanded
        if name == "locate":
            default = None if "use" in content else DEFAULT_FALLBACK
            section["fallback"] = self.items(kind, section.get("fallback"), f"{where}.fallback", default)
        return section

    def items(self, kind: Kind, data: Any, where: str, default: str | None) -> list[Any]:
        """Return what is written in a list of components; one alone is a list of it.

        Args:
            kind: the kind of the components.
            data: the list; None stands for the default.
            where: its path.
            default: the component that is chosen if it is installed and nothing is written.
        """
        if data is None:
            return [default] if default in self.catalog.names(kind.name) else []
        if isinstance(data, list):
            if len(data) > MAX_LISTED:
                self.spec.wrong(where, f"expected at most {MAX_LISTED} {kind.name}s, got {given(data)}")
            return data[:MAX_LISTED]
        self.spec.places = self.spec.places_under(where, f"{where}.0") | self.spec.places
        return [data]

    def fallbacks(self, items: list[Any], where: str, first: Choice | None) -> tuple[Choice, ...]:
        """Resolve the locators to which the pairs that the first one lost are offered."""
        found: list[Choice] = []
        for index, item in enumerate(items):
            path = f"{where}.fallback.{index}"
            choice = self.item(KIND_OF["locate"], item, path)
            if choice is None:
                continue
            name, is_own = choice.contribution.name, self.spec.place(path).where.startswith(where)
            if choice == first and not is_own:  # it became the same by what a level changes
                self.spec.wrong_key(where, f"the fallback {name!r} has the same keys, and {_AGAIN}")
            elif choice in (first, *found):
                self.spec.wrong_key(path, f"{name!r} with the same keys is tried before, and {_AGAIN}")
            else:
                found.append(choice)
        return tuple(found)

    def item(self, kind: Kind, item: Any, where: str) -> Choice | None:
        """Resolve one component of a list: a name, or a mapping."""
        spec = self.spec
        if isinstance(item, str):
            item = {"use": item}
            if where in spec.places:
                spec.places = {f"{where}.use": spec.places[where]} | spec.places
        if not isinstance(item, dict):
            article = "an" if kind.name[0] in "aeiou" else "a"
            expected = f"the name of {article} {kind.name}, or a mapping such as {{use: NAME}}"
            spec.wrong(where, f"expected {expected}, got {given(item)}")
            return None
        known = ["use", "with"]
        if kind is KIND_OF["locate"] and "fallback" in item:
            known.append("fallback")
            message = "a fallback cannot have a fallback; list all of them, in the order in which they are tried"
            spec.wrong_key(f"{where}.fallback", message)
        spec.check_keys(item, where, known, below=self.keys_of(kind, item.get("use")))
        return self.component(kind, item, where)

    def component(self, kind: Kind, section: dict[str, Any], where: str) -> Choice | None:
        """Look up the component that a section names, and validate its keys."""
        entry = self.entry(kind, section, where)
        if entry is None:
            return None
        try:
            config = validate(entry.contribution.config, section.get("with"), f"{where}.with", self.spec)
            if config is not None:
                config.model_dump(mode="json")  # a run records it
        except BaseException as error:
            if is_interrupt(error):
                raise
            self.spec.wrong_key(f"{where}.with", f"the config of the {entry.label} raised {described(error)}")
            return None
        return None if config is None else Choice(entry.contribution, config, entry.origin)

    def entry(self, kind: Kind, section: dict[str, Any], where: str) -> Entry | None:
        """Look up the component that a section names; None if it names none, or one that there is not."""
        use = section.get("use")
        if "use" not in section:
            known = (name for name in self.catalog.names(kind.name) if kind.name == "source" or not self.alias(kind, name))
            self.spec.wrong_key(f"{where}.use", f"required: the name of the {kind.name}; known: {listed(known) or 'none'}")
            return None
        if not isinstance(use, str):
            self.spec.wrong(f"{where}.use", f"expected the name of the {kind.name}, got {given(use)}")
            return None
        try:
            entry = self.catalog.find(kind.name, use)
        except PluginError as error:
            self.spec.wrong(f"{where}.use", str(error))
            return None
        if isinstance(entry.contribution, Alias):  # one that stands where it may has been spelled out
            message = f"{use!r} cannot be part of a chain or a fallback; list the {kind.name}s themselves"
            self.spec.wrong_key(where, message)
            return None
        if entry.unavailable:
            self.spec.wrong(f"{where}.use", entry.unavailable)
        return entry

    def keys_of(self, kind: Kind, name: object) -> Iterable[str]:
        """Return the keys of the component with this name; none if there is no such component."""
        return next((each.contribution.config.model_fields for each in self.catalog.entries(kind.name, name)), ())

    def alias(self, kind: Kind, name: object) -> Alias | None:
        """Return the alias with this name, None if there is none."""
        offered = (entry.contribution for entry in self.catalog.entries(kind.name, name))
        return next((each for each in offered if isinstance(each, Alias)), None)

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

    def level(self, data: Any, where: str, stages: dict[str, _Stage]) -> LevelPlan | None:
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
                selected[name] = self.stage(name, content[name], f"{where}.{name}", stages[name])
            else:
                self.spec.places = self.spec.places_under(name, f"{where}.{name}") | self.spec.places
        choices: dict[str, Any] = {name: stage.choice for name, stage in selected.items()}
        if settings is None or None in choices.values():
            return None
        return LevelPlan(**choices, fallbacks=selected["locate"].fallbacks, scale=settings.scale)


def _settings(name: str, data: Any) -> Any:
    """Return the framework's own keys of a section, without those that choose components."""
    others = {"render": _CHOICE, "output": ("formats",)}.get(name, ())
    return {key: value for key, value in data.items() if key not in others} if isinstance(data, dict) else data


def _written_formats(root: dict[str, Any]) -> Any:
    """Return what is written under `output.formats`; None if there is nothing."""
    output = root.get("output")
    return output.get("formats") if isinstance(output, dict) else None


def _as_list(data: Any) -> list[Any]:
    return data if isinstance(data, list) else [data]


def _name(section: str, data: Any) -> object:
    """Return the name of the component that a section chooses."""
    default = DEFAULTS.get(section)
    return data.get("use", default) if isinstance(data, dict) else default


def _updated(base: Any, keys: Any) -> Any:
    """Lay the keys of a level over those that it goes on from."""
    if isinstance(base, dict) and isinstance(keys, dict):
        return base | keys
    return base if keys is None else keys


def _stage(name: str, choice: Any, fallbacks: Iterable[Choice]) -> dict[str, Any]:
    return _component(choice) | ({"fallback": [_component(each) for each in fallbacks]} if name == "locate" else {})


def _component(choice: Choice) -> dict[str, Any]:
    return {"use": choice.contribution.name, "with": choice.config.model_dump(mode="json", by_alias=True)}


def _level(level: LevelPlan, chosen: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Write a level down: its scale, and the stages in which it differs."""
    own = {name: _stage(name, getattr(level, name), level.fallbacks) for name in STAGES}
    return {"scale": level.scale} | {name: own[name] for name in STAGES if own[name] != chosen[name]}
