"""Warn of a capture whose pixels are read in another order than they were stored in."""

from __future__ import annotations

from photonpano.protocols import PackedSource, Source
from photonpano.reading import other_order, sampled_spans


def order_warning(source: Source) -> str | None:
    """Return a warning if sampled frames of a packed source show another order of pixels in their bytes; None if not.

    Most formats fix the order, and a sensor may arrange its pixels in its own way: so this is no error.
    """
    if not isinstance(source, PackedSource):
        return None
    info = source.info
    spans = sampled_spans(info.n_frames, info.height * -(-info.width // 8))
    other = other_order([source.packed(span) for span in spans])
    if other is None:
        return None
    return f"the pixels of the frames seem to be in another order than they are read in: {other}; check the source and its keys"
