"""Passes that run levels: the first one again through the lens that it found, and all later ones."""

from __future__ import annotations

from dataclasses import replace

from photonpano.motion.level import Level
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.passes.rule import Pass
from photonpano.pipeline.state import State
from photonpano.protocols import camera_of_motion, light_of
from photonpano.values import Decision


class FoundLens(Pass[bool]):
    """Run the first level again: through a lens that nobody knew, pairs were located with errors of pixels."""

    compared = False

    def find(self, state: State) -> bool | None:
        """Return whether the first level has found the distortion of the lens."""
        found = state.model.finds_lens and camera_of_motion(state.trajectory) is not None
        return found or None

    def propose(self, state: State, found: bool) -> State:
        """Locate the first level once more, from its own motion."""
        del found
        return state.located(state.levels[:1], state.trajectory)


class LaterLevels(Pass[tuple[Level, ...]]):
    """Run the levels that are left."""

    compared = False

    def __init__(self, journal: list[Decision]) -> None:
        """Take the decisions of the run: in flickering light, group sizes are chosen anew."""
        self._journal = journal

    def find(self, state: State) -> tuple[Level, ...]:
        """Return all levels, with groups of whole periods of the light where their size is chosen from the capture."""
        light = light_of(state.source)
        if light is None or not light.frequency:
            return state.levels
        self._journal[:] = [each for each in self._journal if each.what != "group_size"]
        return build_levels(state.plan, state.source, self._journal)

    def propose(self, state: State, found: tuple[Level, ...]) -> State:
        """Locate all levels but the first, or a single one again if the capture was corrected since."""
        later = found if state.outdated and len(found) == 1 else found[1:]
        return replace(state, levels=found).located(later, state.trajectory)
