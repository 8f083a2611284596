"""The pass that divides a capture by its vignette, or by the flat field that its spec asks for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from photonpano.context import Context
from photonpano.contributions import MergerContribution
from photonpano.corrections import FlatField, Vignette, divided_by, estimate_vignette
from photonpano.lighting import measure_pixel_gain
from photonpano.pipeline.passes.rule import Pass
from photonpano.pipeline.state import State
from photonpano.protocols import Source, Trajectory
from photonpano.specs.plan import Plan


class Shading(Pass[Vignette]):
    """Divide the capture by the gain of its pixels. Later levels see the difference."""

    compared = False

    def find(self, state: State) -> Vignette | None:
        """Measure the flat field or the vignette along the motion.

        Raises:
            InputError: the motion cannot tell a flat field from the scene, or the camera turns too far.
        """
        source = state.view.source
        if any(isinstance(each, FlatField) for each in state.plan.corrections):
            return _flat_field(source, state.trajectory, state.context)
        return vignette_of(state.plan, source, state.trajectory)

    def propose(self, state: State, found: Vignette) -> State:
        """Divide the source."""
        return replace(state.corrected(divided_by(state.source, found), found, found.decision), vignette=found)


def vignette_of(plan: Plan, source: Source, trajectory: Trajectory) -> Vignette | None:
    """Measure the vignette of a capture, unless its spec lists corrections, or a merger does not accept corrected sums."""
    mergers = [level.merge.contribution for level in plan.levels]
    accepted = all(isinstance(merger, MergerContribution) and merger.accepts_corrected_sums for merger in mergers)
    if not plan.corrects_itself or source.info.kind != "binary" or not accepted:
        return None
    return estimate_vignette(source, trajectory)


def _flat_field(source: Source, trajectory: Trajectory, context: Context) -> Vignette:
    """Measure the gain of every pixel."""
    measured = measure_pixel_gain(source, trajectory, context)
    counts = np.sum([source.counts(span) for span in measured.spans], axis=0) / sum(map(len, measured.spans))
    return Vignette(measured.gain, counts.astype(np.float32), measured.spans, measured.std)
