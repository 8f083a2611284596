"""Write a plan down as a spec, with all defaults."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from photonpano.specs.corrections import AUTO, written_corrections
from photonpano.specs.settings import PANORAMA_ONLY, SETTINGS, STAGES, UNTIL_CONVERGED, VERSION

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from photonpano.specs.components import Stage
    from photonpano.specs.plan import Choice, LevelPlan, Plan


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
        **({} if plan.pose is None else {"pose": _component(plan.pose)}),
        **{name: getattr(plan, name).model_dump(mode="json") for name in SETTINGS},
    }
    document["render"] = _component(plan.renderer) | document["render"]
    document["run"] |= {} if plan.executor is None else {"executor": _component(plan.executor)}
    document["output"] |= {"formats": [_component(each) for each in plan.formats]}
    inapplicable = ("exposures",) if plan.pose is None else ("formats", "keep")
    document["output"] = {key: value for key, value in document["output"].items() if key not in inapplicable}
    return document if plan.pose is None else {key: document[key] for key in document if key not in PANORAMA_ONLY}


def _stage(name: str, choice: Any, fallbacks: Iterable[Choice]) -> dict[str, Any]:
    return _component(choice) | ({"fallback": [_component(each) for each in fallbacks]} if name == "locate" else {})


def _component(choice: Choice) -> dict[str, Any]:
    return {"use": choice.contribution.name, "with": choice.config.model_dump(mode="json", by_alias=True)}


def _level(level: LevelPlan, chosen: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Write a level down: its scale, and the stages in which it differs."""
    own = {name: _stage(name, getattr(level, name), level.fallbacks) for name in STAGES}
    return {"scale": level.scale} | {name: own[name] for name in STAGES if own[name] != chosen[name]}
