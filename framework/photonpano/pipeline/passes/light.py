"""The pass that measures light that changes, and locates the first level in it."""

from __future__ import annotations

import logging
from dataclasses import replace

from photonpano.lighting import corrected_light, decision_of, find_light, in_light, measure_light
from photonpano.pipeline.passes.rule import Pass
from photonpano.pipeline.state import State
from photonpano.protocols import light_of
from photonpano.specs.plan import Plan
from photonpano.values import Light

logger = logging.getLogger(__name__)

# Light that lowers the reduced chi-square of the photons by this factor, or more, is there.
_EXPLAINED = 0.9


class ChangingLight(Pass[Light]):
    """Measure the light along the motion, and locate the first level again in it.

    The first motion was estimated as if the light were steady, so that the light is measured once more along the second one.
    `light: auto` takes the light for steady if it does not change along that, or if it explains the photons worse.
    `light: steady` warns if it changes.
    """

    def __init__(self, plan: Plan) -> None:
        """Take what the spec says: `light: changing` is not compared with steady light."""
        self._mode = plan.light.mode
        self.compared = self._mode != "changing"

    def find(self, state: State) -> Light | None:
        """Measure the light; None if it is steady, or taken for steady."""
        light = self._measured(state)
        if light is not None and self._mode == "steady":
            reason = decision_of(light, state.source.info.frame_rate_hz).reason
            logger.warning(f"light: steady, but {reason}; write light: auto")
            return None
        return light

    def propose(self, state: State, found: Light) -> State | None:
        """Locate the first level in the light, measure that again, and locate the level in it."""
        first = _lit(state, found).located(state.levels[:1], state.trajectory)
        light = self._measured(replace(first, source=state.source, context=state.context))
        return None if light is None else _lit(state, light).located(state.levels[:1], first.trajectory)

    def worse(self, proposed: State, state: State) -> str:
        """Compare as usual, unless the light explains the brightness of the frames.

        The scatter of the shifts does not count then: groups blur the panorama of level 1 by a tremor, and the steps against it
        are wrong by much more than their noise.
        """
        if proposed.fit.misfit < _EXPLAINED * state.fit.misfit:
            return ""
        return super().worse(proposed, state)

    def settled(self, proposed: State, state: State) -> State:
        """Correct the light by what the panorama in it does not explain."""
        light, residuals = light_of(proposed.source), proposed.fit.residuals
        assert light is not None
        corrected = corrected_light(light, residuals.spans, *residuals.gains())
        return replace(_lit(state, corrected), results=proposed.results, outdated=False)

    def rejection(self, found: Light, worse: str) -> str:
        """Say that the light is taken for steady."""
        del found
        return f"the light is taken for steady: in the light that was found, {worse}"

    def _measured(self, state: State) -> Light | None:
        measure = measure_light if self._mode == "changing" else find_light
        return measure(state.view.source, state.trajectory, state.context)


def _lit(state: State, light: Light) -> State:
    """Return the state of a capture in its light."""
    decision = decision_of(light, state.source.info.frame_rate_hz)
    return state.corrected(in_light(state.source, light), light, decision)
