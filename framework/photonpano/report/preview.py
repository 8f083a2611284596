"""Make pictures of a capture: of sums of frames, without any motion; of a simulated one, also of frames without noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import Capture, capture_of
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError
from photonpano.execution.threads import in_order
from photonpano.merging import Chunk, accumulate
from photonpano.merging.colour import composed, in_colours
from photonpano.photometry import tone_mapped
from photonpano.values import FluxImage, FrameSpan, Panorama, StreamInfo

_WHITE_EXPOSURES = 16  # the white flux is a quantile of that many exposures, or views, all over the capture
_WHITE_QUANTILE = 0.999  # of views without noise
_FONT, _FONT_SCALE, _LINE_PX, _MARGIN_PX = cv2.FONT_HERSHEY_PLAIN, 0.8, 14, 3


@dataclass(frozen=True, slots=True)
class Style:
    """The rendering style of pictures."""

    white_flux: float  # the flux that is white, the same in all pictures
    srgb: bool = True  # whether levels follow the sRGB curve; otherwise they are proportional to the flux
    label: bool = True  # whether frames and time are written below each picture


def preview_spans(info: StreamInfo, group_size: int, step: int) -> list[FrameSpan]:
    """Return the frames of each exposure: those within the capture, or all of a capture that is shorter than one."""
    if info.n_frames < group_size:
        return [info.span]
    return [FrameSpan(start, start + group_size) for start in range(0, info.n_frames - group_size + 1, step)]


def white_flux(source: Source, spans: Sequence[FrameSpan], quantile: float, threads: int = 1) -> float:
    """Return a quantile of the flux of the pixels, over 16 of the exposures; 1 if all are dark."""
    chosen = sorted({round(place) for place in np.linspace(0, len(spans) - 1, _WHITE_EXPOSURES)})
    exposures = in_order(lambda place: still_exposure(source, spans[place]), chosen, threads)
    return float(np.nanquantile(np.stack(list(exposures)), quantile)) or 1.0


def pictures(source: Source, spans: Sequence[FrameSpan], style: Style, threads: int = 1) -> Iterator[NDArray[np.uint8]]:
    """Yield the picture of each exposure, in order: (H, W) or (H, W, 3) uint8, and a strip below it for the label."""

    def picture(span: FrameSpan) -> NDArray[np.uint8]:
        image = tone_mapped(still_exposure(source, span), style.white_flux, srgb=style.srgb)
        if not style.label:
            return image
        label = _label(span, source.info)
        return np.vstack([image, label if image.ndim == 2 else np.repeat(label[..., None], 3, axis=-1)])

    return in_order(picture, spans, threads)


def still_exposure(source: Source, *spans: FrameSpan) -> FluxImage:
    """Return the flux of the sum of spans of frames, without motion: (H, W), or (H, W, 3) in colour; NaN where masked."""
    still = [Chunk(span, np.eye(3)) for span in spans]
    if sum(map(len, spans)) == 1:
        # In dimmer light, it has less than the frame of mean light that a flux needs.
        source = replace(capture_of(source), light=None)

    def merged(each: Source) -> Panorama:
        photons = accumulate(each, still, np.eye(3), each.info.frame_shape)
        return Panorama(*photons.estimate(each.response), np.eye(3))

    return composed(in_colours(source, merged), source).flux


def _label(span: FrameSpan, info: StreamInfo) -> NDArray[np.uint8]:
    """Return a strip as wide as a frame that names the frames of an exposure and the time of its middle."""
    rate = info.frame_rate_hz
    text = str(span) if rate is None else f"{span}  {1000 * span.centre / rate:.3f} ms"
    (width, _), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    strip = np.zeros((_LINE_PX, max(width + 2 * _MARGIN_PX, info.width)), np.uint8)
    cv2.putText(strip, text, (_MARGIN_PX, _LINE_PX - _MARGIN_PX), _FONT, _FONT_SCALE, 255, 1, cv2.LINE_AA)
    if strip.shape[1] == info.width:
        return strip
    return np.asarray(cv2.resize(strip, (info.width, _LINE_PX), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def require_sharp_views(source: Source) -> Capture:
    """Return a capture that knows its frames without noise, or raise an `InputError`."""
    capture = capture_of(source)
    if capture.has_sharp_views:
        return capture
    raise InputError(
        "only simulated captures have sharp frames, and not through corrections that move pixels or keep colours; leave out "
        "--sharp-every"
    )


def sharp_pictures(capture: Capture, frames: range, threads: int) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures without noise of some frames, of at least one: (H, W) uint8 each, sRGB, with the same white in all."""
    chosen = sorted({frames[round(place)] for place in np.linspace(0, len(frames) - 1, _WHITE_EXPOSURES)})
    white = max(float(np.quantile(view, _WHITE_QUANTILE)) for view in in_order(capture.sharp_view, chosen, threads)) or 1.0
    return in_order(lambda frame: tone_mapped(capture.sharp_view(frame), white), frames, threads)
