"""One record of a capture as a run sees it: what its source gives, and what was found about it."""

from photonpano.capture.capture import (
    MISSING,
    Capture,
    Colours,
    Gather,
    Index,
    LinearCorrection,
    MaskedSpan,
    capture_of,
    in_light,
    leaving_out,
    numbered,
    part_of,
    seen_through,
    with_background,
)
from photonpano.capture.plugin_source import PluginSource

__all__ = [
    "MISSING",
    "Capture",
    "Colours",
    "Gather",
    "Index",
    "LinearCorrection",
    "MaskedSpan",
    "PluginSource",
    "capture_of",
    "in_light",
    "leaving_out",
    "numbered",
    "part_of",
    "seen_through",
    "with_background",
]
