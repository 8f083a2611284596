"""Pictures of the frames of a simulated capture without noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.photometry import tone_mapped
from photonpano.protocols import KnowsSharpViews, Source
from photonpano.threads import in_order

_WHITE_VIEWS, _WHITE_QUANTILE = 16, 0.999
"""White is the largest of these quantiles of the flux, over frames all along the capture."""


def require_sharp_views(source: Source) -> KnowsSharpViews:
    """Return a source that knows what its frames show without noise.

    Raises:
        InputError: it does not.
    """
    if isinstance(source, KnowsSharpViews):
        return source
    raise InputError(
        "only simulated captures have sharp frames, and not through corrections that move pixels or keep colours; leave out "
        "--sharp-every"
    )


def sharp_pictures(source: KnowsSharpViews, frames: range, threads: int) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures of some frames, of at least one: (H, W) uint8 each, sRGB, with the same white in all."""
    chosen = sorted({frames[round(place)] for place in np.linspace(0, len(frames) - 1, _WHITE_VIEWS)})
    white = max(float(np.quantile(view, _WHITE_QUANTILE)) for view in in_order(source.sharp_view, chosen, threads)) or 1.0
    return in_order(lambda frame: tone_mapped(source.sharp_view(frame), white), frames, threads)
