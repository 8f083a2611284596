"""Make the record of a capture from any source, and add to it what was found."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from photonpano.capture.capture import Capture, Colours
from photonpano.capture.plugin_source import PluginSource

if TYPE_CHECKING:
    from photonpano.geometry import Camera
    from photonpano.protocols import Source
    from photonpano.values import FrameSpan, Light


def capture_of(source: Source, origin: str | None = None) -> Capture:
    """Return the capture that a source gives; a capture as it is.

    Args:
        source: the source, with any of the optional methods.
        origin: who provides it, such as "source 'packed-npy' of photonpano 0.1.0": properties and arrays are checked, and
            errors name the plugin, whoever reads. None for a source that is neither checked nor named.

    Raises:
        PluginError: a property of the source is not what it should be.
    """
    return source if isinstance(source, Capture) else _capture_of(PluginSource(source, origin))


def in_light(source: Source, light: Light) -> Capture:
    """Return a capture with the gain of each of its frames. Counts stay as they are; what sums them divides by the gains."""
    return replace(capture_of(source), light=light)


def seen_through(source: Source, camera: Camera) -> Capture:
    """Return a capture with its camera. Counts stay as they are; what warps frames uses the lens."""
    return replace(capture_of(source), camera=camera)


def part_of(source: Source, span: FrameSpan) -> Capture:
    """Return the frames of a span as a capture of its own, whose first frame has the index 0."""
    whole = capture_of(source)
    light = None if whole.light is None else whole.light.part(span)
    return replace(whole, info=replace(whole.info, n_frames=len(span)), first=whole.first + span.start, light=light)


def _capture_of(source: PluginSource) -> Capture:
    colour = None
    if source.offers("colours"):
        parts = {name: _capture_of(each) for name, each in source.colours().items()}
        colour = Colours(parts, source.clear_mix())
    return Capture(
        source,
        source.info,
        source.valid,
        steps=(source.corrected,) if source.offers("corrected") else (),
        weight=source.weights() if source.offers("weights") else None,
        light=source.light if source.offers("light") else None,
        camera=source.camera if source.offers("camera") else None,
        colour=colour,
    )
