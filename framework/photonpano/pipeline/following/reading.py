"""Read the frames that have arrived as the run will read them: with its corrections, and without pixels that stand still."""

from __future__ import annotations

from dataclasses import replace

from photonpano.capture import Capture, capture_of
from photonpano.corrections import without_still_pixels
from photonpano.pipeline.components import require_suitable, with_corrections
from photonpano.protocols import Source
from photonpano.specs.plan import Plan
from photonpano.values import BoolArray

_LONG = 1_000_000  # frames of a capture whose length is not known yet, for checks of the stages


class ArrivedFrames:
    """Corrects the frames that have arrived. What stands still is found anew whenever twice as many frames are there."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._valid: BoolArray | None = None
        self._found_at = 0

    def of(self, arrived: Source, promised: int | None) -> Capture:
        """Return a capture with its corrections.

        Raises:
            InputError: a correction does not suit it.
            PluginError: the source broke its contract.
            SpecError: a stage does not suit it.
        """
        source = with_corrections(self._plan, capture_of(arrived, self._plan.source.label))
        if not self._found_at:
            require_suitable(self._plan, source, replace(source.info, n_frames=promised or _LONG))
            self._found_at = 1
        if not self._plan.corrects_itself or source.info.kind != "binary" or source.info.bayer is not None:
            return source
        if self._valid is None or source.info.n_frames >= 2 * self._found_at:
            self._valid, self._found_at = without_still_pixels(source).valid, source.info.n_frames
        return replace(source, valid=self._valid)
