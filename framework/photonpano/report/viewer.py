"""Gather what the viewer of a report shows: linear data, maps over the panorama, the path, and pictures of one instant."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from photonpano.capture import capture_of, with_background
from photonpano.contracts.protocols import Source
from photonpano.geometry import Canvas, inverse, outline_of, rescaling
from photonpano.merging.colour import channels_of
from photonpano.merging.panorama import RenderedPanorama
from photonpano.merging.seen_frames import NEVER
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import LevelResult
from photonpano.photometry import balanced, tone_mapped
from photonpano.record.schema import RunRecord
from photonpano.report.drawing import jpeg_uri, map_of, png_uri, shrunk
from photonpano.report.figures import centre_of, chi2_cells, instants_of, places_on, same_projection
from photonpano.report.preview import still_exposure
from photonpano.residuals.refinement import Explained, distance_to_nearest
from photonpano.values import Background, FloatArray, FluxImage, FrameSpan

# Maximum number of values of linear data, some megabytes; a larger panorama is reduced.
LINEAR_VALUES = 1_200_000
CODES = 4095  # codes of 12 bits, logarithmic in the flux
DECADES = 5.0  # range of the codes, in powers of ten below the highest flux: a step is 0.28 %
# Number of short sums of frames on the page; fewer in colour, where a sum takes a hundred times as long.
GLIMPSES, COLOURED_GLIMPSES = 40, 12
GLIMPSE_PIXELS = 240
TINT = "#ff3d9a"  # over what hides the background; its opacity, and that of its outline, follow
_OPACITY, _OUTLINE = 80, 255
VIEW_PIXELS = 1000  # longer side of the pictures of one instant
_INSTANTS = 600  # number of frames whose outline is on the page
# Of a long capture, the average is of spans all over it: so many that one lies less than a pixel from the next on most paths.
_AVERAGED, _AVERAGED_FRAMES = 2000, 10


def viewer_data(
    record: RunRecord, explained: Explained, panorama: RenderedPanorama, source: Source, levels: Sequence[LevelResult]
) -> dict[str, Any]:
    """Return what the viewer needs, as plain data for JSON. Frames are read, and exposures merged again."""
    motion, white = explained.motion, panorama.white_flux
    render = record["spec"].get("render") or {}
    balance: Any = render.get("white_balance", "none")
    balance = balance if isinstance(balance, str) else tuple(balance)
    instant = shared_instant(motion, levels)
    spans = [len(span) for span in explained.residuals.spans]
    background = capture_of(source).background
    return {
        "size": [panorama.canvas.width, panorama.canvas.height],
        "angles": angles_of(panorama.canvas),
        "linear": linear_data(balanced(panorama.thumbnail.flux, balance), white),
        "picture": None if (render.get("tone") or "srgb") == "srgb" else jpeg_uri(shrunk(panorama.picture, VIEW_PIXELS)),
        "maps": [*panorama_maps(panorama), *_chi2_map(explained, panorama.canvas)],
        "path": path_data(motion, panorama),
        "rate": record["source"]["frame_rate_hz"],
        "glimpses": glimpses(source, int(np.median(spans)), white),
        "tint": None if background is None else TINT,
        "instant": instant,
        "views": views_of_instant(instant, motion, panorama, with_background(source, None), levels),
    }


def angles_of(canvas: Canvas) -> dict[str, Any] | None:
    """Return the borders of a canvas on a sphere, or of a full turn, as coordinates of its projection, or None."""
    if canvas.projection != "spherical" and not canvas.is_full_turn:
        return None
    borders = (_corners(canvas.shape)[::2] - canvas.transform[:2, 2]) / np.diag(canvas.transform)[:2]
    across, down = borders.T.tolist()
    return {"projection": canvas.projection, "across": across, "down": down}


def linear_data(flux: FluxImage, white: float) -> dict[str, Any]:
    """Encode flux for a browser: `low * (high / low) ** ((code - 1) / (codes - 1))`, and the code 0 where nothing was seen.

    Codes take two bytes; all high bytes come before all low ones, and `zlib` packs them. So a browser needs no decoder of
    pictures, which may change colours. The flux is (H, W) or (H, W, 3), NaN where nothing was seen.
    """
    channels = 1 if flux.ndim == 2 else flux.shape[2]
    seen = np.isfinite(flux)
    longest = max(flux.shape[:2]) * min(1.0, float(np.sqrt(LINEAR_VALUES / flux.size)))
    if longest < max(flux.shape[:2]):
        share = shrunk(seen.astype(np.float32), int(longest))
        flux = np.where(share > 0, shrunk(np.where(seen, flux, 0), int(longest)) / np.maximum(share, 1e-6), np.nan)
        seen = np.isfinite(flux)
    high = (float(flux[seen].max()) if seen.any() else 0.0) or 1.0
    low = high / 10**DECADES
    with np.errstate(invalid="ignore", divide="ignore"):
        place = np.log(np.maximum(flux, low) / low) / np.log(high / low)
    codes = np.where(seen, 1 + np.rint((CODES - 1) * np.nan_to_num(place)), 0).astype(np.uint16).ravel()
    packed = zlib.compress((codes >> 8).astype(np.uint8).tobytes() + (codes & 255).astype(np.uint8).tobytes())
    return {
        "width": flux.shape[1],
        "height": flux.shape[0],
        "channels": channels,
        "low": low,
        "high": high,
        "codes": CODES,
        "white": white,
        "data": base64.b64encode(packed).decode(),
    }


def panorama_maps(panorama: RenderedPanorama) -> list[dict[str, Any]]:
    """Return the coverage, and the standard deviation of the flux relative to it, as maps over the panorama."""
    flux, weight = panorama.thumbnail.flux, panorama.thumbnail.weight
    height, width = panorama.canvas.shape
    box = [0, 0, width, height]
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = 100 * panorama.std / flux
    if flux.ndim == 3:
        weight, relative = weight.sum(axis=-1), relative.mean(axis=-1)
    seen = weight > 0
    percent = np.where(seen & np.isfinite(relative), relative, np.nan)
    first, last = (np.where(each < NEVER, each, np.nan) for each in panorama.seen_frames)
    return [
        _map("Coverage", np.where(seen, weight, np.nan), "frames", box=box, colours="viridis", low=0.0),
        _map("Uncertainty", percent, "% of the flux", box=box, colours="magma"),
        _map("First seen", first, "(frame)", box=box, colours="viridis"),
        _map("Last seen", last, "(frame)", box=box, colours="viridis"),
    ]


def _chi2_map(explained: Explained, canvas: Canvas) -> list[dict[str, Any]]:
    if not same_projection(explained.canvas, canvas):
        return []
    reduced_chi2, (left, top, right, bottom) = chi2_cells(explained.residuals, explained.canvas, canvas.transform)
    box = [round(float(side) + 0.5, 2) for side in (left, top, right, bottom)]
    return [_map("Reduced chi-square", reduced_chi2, "(1 is photon noise)", box=box, colours="inferno")]


def _map(
    name: str, values: FloatArray | FluxImage, unit: str, *, box: Sequence[float], colours: str, low: float | None = None
) -> dict[str, Any]:
    """Return a map as a picture in colours, transparent where it is NaN, with its legend."""
    known = values[np.isfinite(values)]
    first, last = (float(each) for each in np.quantile(known, (0.01, 0.99))) if known.size else (0.0, 1.0)
    return {"name": name, "unit": unit, "box": list(box), **map_of(values, colours, first if low is None else low, last)}


def path_data(motion: FrameMotion, panorama: RenderedPanorama) -> dict[str, Any]:
    """Return where frames lie on the panorama, in its pixels, at instants all over the capture."""
    instants = instants_of(len(motion.homographies), _INSTANTS)
    border = outline_of(motion.frame_shape) if not panorama.canvas.planar else _corners(motion.frame_shape)
    outlines = places_on(panorama, motion.homographies[instants], np.vstack([border, border[:1]]))
    centres = places_on(panorama, motion.homographies[instants], centre_of(motion.frame_shape))[:, 0]
    factor = panorama.reduction
    std = [round(float(each), 4) if np.isfinite(each) else None for each in motion.std_px[instants]]
    return {
        "frames": instants.tolist(),
        "centres": _rounded(centres * factor),
        "outlines": _rounded(outlines * factor),
        "wide": not panorama.canvas.planar,
        "std": std,
        "start": int(np.abs(instants - motion.reference).argmin()),
    }


def _corners(frame_shape: tuple[int, int]) -> FloatArray:
    height, width = frame_shape
    return np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])


def _rounded(points: FloatArray) -> Any:
    return np.round(np.nan_to_num(points), 1).tolist()


def glimpses(source: Source, n_frames: int, white: float) -> list[dict[str, Any]]:
    """Return short sums of frames, all over the capture, of all photons; and what hides the background, if anything does."""
    total, background, source = source.info.n_frames, capture_of(source).background, with_background(source, None)
    n_frames = min(n_frames, total)
    most = COLOURED_GLIMPSES if channels_of(source) > 1 else GLIMPSES
    found = []
    for start in np.unique(np.linspace(0, total - n_frames, min(most, total)).astype(int)):
        span = FrameSpan(int(start), int(start) + n_frames)
        picture = shrunk(tone_mapped(still_exposure(source, span), white), GLIMPSE_PIXELS)
        frame = (span.start + span.stop - 1) // 2
        found.append({"frame": frame, "first": span.start, "last": span.stop - 1, "uri": jpeg_uri(picture, quality=75)})
        if background is not None:
            found[-1] |= _tint(background, frame, picture.shape[:2])
    return found


def _tint(background: Background, frame: int, shape: tuple[int, int]) -> dict[str, Any]:
    """Return a picture to lay over a frame, and the share of the frame that hides the background."""
    shown = background.pixels(FrameSpan(frame, frame + 1))
    hidden = 1 - (np.ones(background.frame_shape, np.uint8) if shown is None else shown)
    inside = cv2.resize(hidden, shape[::-1], interpolation=cv2.INTER_NEAREST)
    colours = np.full((*shape, 4), [*bytes.fromhex(TINT[1:]), 0], np.uint8)
    colours[..., 3] = np.where(inside > cv2.erode(inside, np.ones((3, 3))), _OUTLINE, _OPACITY * inside)
    return {"tint": png_uri(colours), "hidden": round(float(hidden.mean()), 4)}


def shared_instant(motion: FrameMotion, levels: Sequence[LevelResult]) -> int:
    """Return a located frame near an exposure of every level; of several such frames the one nearest to the reference frame."""
    located = [result.located.instants for result in levels]
    candidates = np.rint(located[-1]).astype(int)
    gap = np.sum([distance_to_nearest(instants, candidates) for instants in located], axis=0)
    order = np.lexsort((np.abs(candidates - motion.reference), np.rint(gap)))
    return int(np.clip(candidates[order[0]], 0, len(motion.homographies) - 1))


def views_of_instant(
    frame: int, motion: FrameMotion, panorama: RenderedPanorama, source: Source, levels: Sequence[LevelResult]
) -> list[dict[str, Any]]:
    """Return pictures of what a frame shows: itself, the plain average, the exposure of each level, and the panorama."""
    height, width = motion.frame_shape
    scale = float(np.clip(panorama.canvas.transform[0, 0] if panorama.canvas.planar else 1.0, 1, max(1, VIEW_PIXELS / width)))
    shape = round(height * scale), round(width * scale)
    to_frame = rescaling(1 / scale)
    x, y = np.meshgrid(np.arange(shape[1], dtype=np.float64), np.arange(shape[0], dtype=np.float64))
    pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    here = motion.homographies[frame] @ to_frame @ pixels  # on the reference plane

    def view(name: str, note: str, image: FluxImage, places: FloatArray, sharp: bool = False) -> dict[str, Any]:
        # Of an image of more than 32,767 px a side, OpenCV takes parts only.
        ends = np.nan_to_num([places.min(axis=1) - 1, places.max(axis=1) + 3])
        parts = [slice(*each) for each in np.clip(ends, 0, image.shape[1::-1]).astype(int).T.tolist()]
        if 0 not in (part := image[parts[1], parts[0]]).shape:
            image, places = part, places - [[each.start] for each in parts]
        across, down = (each.reshape(shape).astype(np.float32) for each in places)
        how = cv2.INTER_NEAREST if sharp else cv2.INTER_LINEAR
        warped = cv2.remap(image, across, down, how, borderMode=cv2.BORDER_CONSTANT, borderValue=[float("nan")] * 4)
        return {"name": name, "note": note, "uri": jpeg_uri(tone_mapped(np.asarray(warped, np.float32), panorama.white_flux))}

    def on(transform: FloatArray, rays: FloatArray) -> FloatArray:
        moved = transform @ rays
        return np.asarray(moved[:2] / moved[2])

    itself = on(to_frame, pixels)
    averaged = source.info.spread(_AVERAGED, _AVERAGED_FRAMES)
    alone = still_exposure(source, FrameSpan(frame, frame + 1))
    alone *= panorama.white_flux / (float(np.nanmax(alone, initial=0)) or 1.0)  # a lit pixel of a binary frame is white
    number, total = sum(map(len, averaged)), source.info.n_frames
    among = f"all {total:,} frames" if number == total else f"{number:,} of {total:,} frames"
    found = [
        view("One frame", f"frame {frame:,}", alone, itself, sharp=True),
        view("Plain average", f"{among}, without motion", still_exposure(source, *averaged), itself),
    ]
    for result in levels:
        index = int(np.flatnonzero(result.located.solution.located)[np.abs(result.located.instants - frame).argmin()])
        exposure = result.exposures.merged(index)
        instant = np.array([exposure.group.reference], np.float64)
        to_exposure = rescaling(exposure.scale) @ inverse(motion.trajectory.at(instant))[0]
        note = f"frames {exposure.group.span.start:,} to {exposure.group.span.stop - 1:,}, along the motion known before"
        found.append(view(f"Level {result.level.number}", note, exposure.flux, on(to_exposure, here)))
    places = panorama.canvas.pixels((panorama.canvas.plane_to_rays @ here).T).T
    reduced = (places + 0.5) / panorama.reduction - 0.5
    seen = round(float(np.nanmax(panorama.thumbnail.weight)))
    found.append(view("Panorama", f"up to {seen:,} frames a pixel", panorama.thumbnail.flux, reduced))
    return found
