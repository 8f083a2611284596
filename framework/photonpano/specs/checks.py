"""Ask the components what is wrong: of the source before it is opened, of the stages once the capture is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano.registry.kinds import KINDS
from photonpano.specs.tree import Place

if TYPE_CHECKING:
    from photonpano.errors import Problem
    from photonpano.specs.plan import Choice, Plan
    from photonpano.values import StreamInfo

STAGES = tuple(kind.section for kind in KINDS.values() if kind.section != "source")
"""The sections of a spec that choose the components of a level, in the order of the loop."""


def check_stream(plan: Plan, info: StreamInfo) -> list[Problem]:
    """Check a plan against its capture: every stage of every level, and the frame that the panorama lies in.

    Reads no data. What levels share is checked once.

    Returns:
        The problems, each at its place in the spec; empty if there are none.
    """
    sentences: dict[tuple[str, str], str] = {}
    own = [{}] * len(plan.levels) if plan.until_converged else plan.document["levels"]
    for index, (level, written) in enumerate(zip(plan.levels, own, strict=True)):
        choices = {f"levels.{index}.{stage}" if stage in written else stage: getattr(level, stage) for stage in STAGES}
        replaced = f"levels.{index}.locate.fallback"
        fallback = replaced if f"{replaced}.0" in plan.places else "locate.fallback"
        choices |= {f"{fallback}.{rank}": choice for rank, choice in enumerate(level.fallbacks)}
        for where, choice in choices.items():
            for sentence in complaints(choice, info):
                sentences.setdefault((choice.contribution.name, sentence), where)
    problems = [plan.places.get(where, Place(where)).problem(sentence) for (_, sentence), where in sentences.items()]
    reference = plan.render.reference
    if isinstance(reference, int) and reference >= info.n_frames:
        place = plan.places.get("render.reference", Place("render.reference"))
        problems.append(place.problem(f"expected a frame of the capture, 0 to {info.n_frames - 1}, got {reference}"))
    return problems


def complaints(choice: Choice, *stream: StreamInfo) -> tuple[str, ...]:
    """Run the `check` of a component; one that fails is a complaint itself."""
    contribution = choice.contribution
    try:
        found = contribution.check(choice.config, *stream)
        return (found,) if isinstance(found, str) else tuple(map(str, found))
    except Exception as error:
        return (f"the check of the {choice.label} raised {type(error).__name__}: {error}",)
