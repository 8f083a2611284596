"""Divide sums of frames by the gain of the pixels: a vignette, or a flat field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from photonpano.capture import Capture, LinearCorrection, capture_of
from photonpano.corrections.pixels import Correction
from photonpano.errors import InputError
from photonpano.reading import read_arrays
from photonpano.values import Decision, FrameSpan

if TYPE_CHECKING:
    from pathlib import Path

    from photonpano.corrections.pixels import Decide, Pixels
    from photonpano.protocols import Source
    from photonpano.values import FluxImage

VIGNETTE_DECISION, FLAT_FIELD_DECISION = "vignette_gain", "flat_field"  # names of the decisions in a record
VIGNETTE_FILE = "vignette.npz"


class FlatField(Correction):
    """Divides by the gain of the pixels, which the run measures after level 1 from a scene that moves through the frame."""

    name: ClassVar[str] = "flat-field"

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """See `Correction`: no pixel is moved or masked, and the gain is not known before the motion is."""
        del decide
        if capture.info.kind != "binary":
            raise InputError("flat-field divides sums of binary frames, and these frames are intensities; leave it out")
        return pixels


@dataclass(frozen=True, slots=True, eq=False)
class Vignette:
    """The relative sensitivity of the pixels."""

    gain: FluxImage  # (H, W) float32, 1 in the middle, or on average if it is a flat field
    mean: FluxImage  # (H, W) float32, mean count of a frame of each pixel, around which the division is linear
    spans: tuple[FrameSpan, ...]  # the frames that it was estimated from
    std: FluxImage | None = None  # (H, W) float32, standard deviation of the gain, relative to it; None for a vignette

    @property
    def decision(self) -> Decision:
        """What was found, for the record."""
        corner, n_frames = float(self.gain[0, 0]), sum(map(len, self.spans))
        if self.std is not None:
            known = f"known to {np.median(self.std):.2g} in half of the frame, and to {self.std.max():.2g} everywhere"
            reason = f"root mean square of the differences in gain, from {n_frames} frames, {known}; the flux is divided by it"
            return Decision(FLAT_FIELD_DECISION, round(float(self.gain.std()), 3), reason)
        reason = f"light that reaches the corners, relative to the middle, from {n_frames} frames; the flux is divided by it"
        return Decision(VIGNETTE_DECISION, round(corner, 3), reason)

    def correction(self) -> LinearCorrection:
        """Return the division of sums of frames.

        A pixel of gain g is lit with the probability `p = 1 - exp(-g f)`, and one of gain 1 with `q = 1 - (1 - p)^(1 / g)`.
        Sums are corrected from p to q, linearly around the mean of each pixel.
        """
        power, dark = 1 / self.gain, np.maximum(1 - self.mean, np.float32(1e-3))
        slope = np.asarray(power * dark ** (power - 1), np.float32)
        return LinearCorrection(slope, np.asarray(1 - dark**power - slope * (1 - dark), np.float32))


def divided_by(source: Source, vignette: Vignette) -> Capture:
    """Return a capture, with its colours, whose corrected sums are those of pixels of gain 1.

    Pixels of a flat field may differ so far in gain that faint ones, which are multiplied most, would add more noise than
    light: they are weighted by the photons that they count, relative to a pixel of gain 1.
    """
    capture, correction = capture_of(source), vignette.correction()

    def divided(each: Capture) -> Capture:
        weight = each.weight
        if vignette.std is not None:
            weight = np.asarray(vignette.gain if weight is None else weight * vignette.gain, np.float32)
        return replace(each, steps=(*each.steps, correction), weight=weight)

    if capture.colour is None:
        return divided(capture)
    parts = {name: divided(each) for name, each in capture.colour.parts.items()}
    return replace(divided(capture), colour=replace(capture.colour, parts=parts))


def write_vignette(folder: Path, vignette: Vignette) -> None:
    """Write vignette.npz into a folder."""
    arrays = {"gain": vignette.gain, "mean": vignette.mean}
    if vignette.std is not None:
        arrays["std"] = vignette.std
    np.savez(folder / VIGNETTE_FILE, allow_pickle=False, **arrays)


def read_vignette(folder: Path, source: Source) -> Vignette | None:
    """Read the vignette of a run folder; None if there is none.

    Raises:
        InputError: the file is damaged, or of frames of another size.
    """
    path = folder / VIGNETTE_FILE
    if not path.exists():
        return None
    arrays = read_arrays(path, "the vignette of a run")
    shape = source.info.frame_shape
    for name in ("gain", "mean"):
        image = arrays.get(name)
        if image is None or image.dtype != np.float32 or image.shape != shape:
            held = "missing" if image is None else f"{image.dtype} of shape {image.shape}"
            raise InputError(f"{path}: {name} must be float32 of shape {shape}, as the frames, and is {held}; run again")
    return Vignette(arrays["gain"], arrays["mean"], (), arrays.get("std"))
