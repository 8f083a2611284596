"""The pass that cuts the motion where the image jumps."""

from __future__ import annotations

import logging
from dataclasses import replace

from photonpano.motion.timeline import Cut
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.passes.rule import Pass
from photonpano.pipeline.state import State
from photonpano.residuals.cuts import find_cuts


class Cuts(Pass[tuple[Cut, ...]]):
    """Cut the motion where the image jumps, and locate all levels again: exposures across a jump mislead the first one, too."""

    severity = logging.WARNING

    def find(self, state: State) -> tuple[Cut, ...] | None:
        """Return where the image jumps."""
        return find_cuts(state.source, state.fit, state.context) or None

    def propose(self, state: State, found: tuple[Cut, ...]) -> State:
        """Locate all levels along the timeline with these cuts."""
        cut = replace(state, timeline=state.timeline.cut_at(found), levels=build_levels(state.plan, state.source, []))
        cut = cut.located(cut.levels, state.start)
        measured = [each.along(cut.motion.trajectory, cut.motion.frame_shape) for each in found]
        return replace(cut, timeline=cut.timeline.cut_at(measured))

    def worse(self, proposed: State, state: State) -> str:
        """Compare as usual, unless frames show nothing.

        Dark frames contradict any motion, and a surer one the more. Their run is doubtful in any case.
        """
        found = super().worse(proposed, state)
        return "" if any(each.dark is not None for each in proposed.timeline.cuts) else found

    def rejection(self, found: tuple[Cut, ...], worse: str) -> str:
        """Name the places."""
        places = ", ".join(f"frame {each.frame}" for each in found)
        return f"the image seems to jump before {places}, but the motion is not cut there: {worse}"
