"""Run the checks of components: of a source before it is opened, of the stages once the capture is known."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

from photonpano.errors import described
from photonpano.interrupts import is_interrupt
from photonpano.registry.kinds import KINDS

if TYPE_CHECKING:
    from photonpano.errors import Problem
    from photonpano.specs.plan import Choice, Plan
    from photonpano.values import StreamInfo

STAGES = tuple(KINDS[name].section for name in ("resampler", "merger", "locator", "interpolator"))
"""The sections of a spec that choose the components of a level, in the order of the loop."""
MAX_COMPLAINTS = 100
"""Most problems of one component that are reported."""


def check_stream(plan: Plan, info: StreamInfo) -> list[Problem]:
    """Check a plan against its capture: all stages, refiners and the renderer, and the reference frame.

    Reads no data. What levels share is reported once.

    Returns:
        The problems, each at its place in the spec; empty if there are none.
    """
    choices: dict[str, Choice] = {} if plan.pose is None else {"pose": plan.pose}
    for index, level in enumerate(plan.levels):
        choices |= {f"levels.{index}.{stage}": getattr(level, stage) for stage in STAGES}
        choices |= {f"levels.{index}.locate.fallback.{rank}": choice for rank, choice in enumerate(level.fallbacks)}
    choices |= {f"refine.{index}": choice for index, choice in enumerate(plan.refine)}
    choices["render"] = plan.renderer
    choices |= {f"output.formats.{index}": choice for index, choice in enumerate(plan.formats)}
    sentences: dict[tuple[str, str], str] = {}
    for where, choice in choices.items():
        for sentence in complaints(choice, info):
            sentences.setdefault((choice.contribution.name, sentence), where)
    problems = [plan.place(where).problem(sentence) for (_, sentence), where in sentences.items()]
    reference = plan.render.reference
    if isinstance(reference, int) and reference >= info.n_frames:
        message = f"expected a frame of the capture, 0 to {info.n_frames - 1}, got {reference}"
        problems.append(plan.place("render.reference").problem(message))
    return problems


def complaints(choice: Choice, *stream: StreamInfo) -> tuple[str, ...]:
    """Run the `check` of a component; one that raises is a complaint itself."""
    try:
        found = choice.contribution.check(choice.config, *stream)
        return (found,) if isinstance(found, str) else tuple(map(str, islice(found, MAX_COMPLAINTS)))
    except BaseException as error:
        if is_interrupt(error):
            raise
        return (f"the check of the {choice.label} raised {described(error)}",)
