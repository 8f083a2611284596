"""The correction that divides by a flat field, which the run measures along its motion."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from photonpano.corrections.pixels import Correction
from photonpano.errors import InputError

if TYPE_CHECKING:
    from photonpano.corrections.pixels import Decide, Pixels
    from photonpano.protocols import Source


class FlatField(Correction):
    """Divides by the gain of the pixels, which the run measures after level 1 from a scene that moves through the frame."""

    name: ClassVar[str] = "flat-field"

    def applied(self, pixels: Pixels, source: Source, decide: Decide | None) -> Pixels:
        """See `Correction`: no pixel is moved or masked, and the gain is not known before the motion is."""
        del decide
        if source.info.kind != "binary":
            raise InputError("flat-field divides sums of binary frames, and these frames are intensities; leave it out")
        return pixels
