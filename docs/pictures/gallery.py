"""Pictures of real captures: a resolution chart that turns on a fan, how much of its bars is left, and a nebula in X-rays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import cv2
import numpy as np
import picture_parts as draw
from harness import EXAMPLES, Study
from numpy.typing import NDArray

from photonpano import load_panorama, load_spec, load_trajectory, open_source, run, warp
from photonpano.geometry import transform_points, translation

# From pixels of the middle frame of usaf.yaml to the chart, upright, 4 px for each.
_TILT_RAD, _ZOOM, _CHART_SIZE = np.deg2rad(31.8), 4.0, (1000, 1240)
_FRAME_CENTRE = (272.0, 162.0)
# Middles of the upright and of the level bars of each element, on the upright chart; group -2 and then group -1, as labelled.
_BARS = (
    ((824, 289), (821, 493)), ((263, 837), (263, 653)), ((439, 844), (439, 681)),
    ((593, 849), (594, 704)), ((730, 854), (730, 726)), ((850, 858), (850, 744)),
    ((237, 247), (236, 352)), ((335, 247), (334, 337)), ((419, 241), (419, 324)),
    ((497, 240), (496, 312)), ((564, 240), (564, 304)), ((626, 236), (621, 293)),
)  # fmt: skip
_PERIOD = 57.7  # of the bars of the first element; that of the next is shorter by the sixth root of 2
_REACH = 8  # px of the upright chart by which bars may lie beside their places
_FRAMES = (5, 10, 20, 40, 70, 100)
_PULSAR, _AROUND, _STEP = (272, 222), 60, 0.5  # x and y of the pulsar, and what is shown around it, in px of 4x4 pixels
_KNOWN_DEG, _KNOWN_CENTRE = -3.40, (231.0, 233.0)  # turn of the fan by frame, and its axis: where merged frames vary most


def usaf(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield the chart in a frame, the average and the panorama, and a plot of the contrast of its bars; print the contrast."""
    folder = study.folder / "usaf"
    plan = load_spec(EXAMPLES / "pipelines" / "usaf.yaml", output=folder)
    if not (folder / "run.json").exists():
        run(plan)
    with open_source(plan) as source:
        frames = source.frames(source.info.span)
    middle = len(frames) // 2
    found = load_trajectory(folder).homographies
    known = np.array([_turned(frame - middle) for frame in range(len(frames))])
    motions = {"panorama": found, "mean turn": known, "average": np.broadcast_to(np.eye(3), found.shape)}
    merged = {name: {n: _merged(frames, motion, n) for n in _FRAMES} for name, motion in motions.items()}
    shown = {
        "one frame": frames[middle].astype(np.float32),
        f"average of {len(frames)}": merged["average"][len(frames)],
        "mean turn of the fan": merged["mean turn"][len(frames)],
        "panorama": np.nan_to_num(load_panorama(folder).flux),
    }
    upright = {name: draw.picture(_upright(image, 1.5)) for name, image in shown.items()}
    yield "usaf.png", draw.beside(draw.all_labelled(upright))
    places = {name: _places(images[_FRAMES[-1]]) for name, images in merged.items()}
    places["average"] = places["panorama"]
    contrasts = {name: {n: _contrasts(image, places[name]) for n, image in images.items()} for name, images in merged.items()}
    yield "usaf-contrast.png", _plot(contrasts)
    for name, of_frames in contrasts.items():
        for n, values in of_frames.items():
            print(name, n, " ".join(f"{value:.2f}" for value in values))


def nebula(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield the photons of a nebula as they fell on the sensor, along the motion, and along that of the star tracker."""
    capture, folder = EXAMPLES / "pipelines" / "nebula", study.folder / "nebula"
    if not (folder / "run.json").exists():
        run(load_spec(capture.with_suffix(".yaml"), output=folder))
    found = load_trajectory(folder).homographies
    with np.load(capture / "truth.npz") as truth, np.load(capture / "photons.npz") as photons:
        known, (frame, x, y) = truth["homographies"], (photons[name].astype(int) for name in ("frame", "x", "y"))
    motions = {
        "as they fell on the sensor": np.broadcast_to(np.eye(3), found.shape),
        "along the motion that was found": found,
        "along that of the star tracker": np.linalg.inv(known[len(known) // 2]) @ known,
    }
    shown = {}
    for name, motion in motions.items():
        # The motion is a shift to 0.1 px over the part that is shown.
        move = transform_points(motion, np.array([_PULSAR], float))[:, 0] - _PULSAR
        edges = [np.arange(middle - _AROUND, middle + _AROUND, _STEP) for middle in _PULSAR[::-1]]
        image, _, _ = np.histogram2d(y + move[frame, 1], x + move[frame, 0], edges)
        smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
        shown[name] = draw.picture(cv2.resize(np.sqrt(smooth), None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC))
    yield "nebula.png", draw.beside(draw.all_labelled(shown))


def _turned(frames: int) -> NDArray[np.float64]:
    """Return the map of a frame to the middle one, by the mean turn of the fan."""
    turn = np.vstack([cv2.getRotationMatrix2D(_KNOWN_CENTRE, _KNOWN_DEG * frames, 1.0), [0, 0, 1]])
    return np.asarray(turn, np.float64)


def _merged(frames: NDArray[np.uint8], motion: NDArray[np.float64], n: int) -> NDArray[np.float32]:
    """Return the flux of n frames in the middle, merged along a motion."""
    part = slice(len(frames) // 2 - n // 2, len(frames) // 2 + (n + 1) // 2)
    with np.errstate(invalid="ignore"):
        share = np.nanmean(warp(frames[part], motion[part]), axis=0)
    return np.asarray(-np.log1p(-np.clip(np.nan_to_num(share), 0, 0.99)), np.float32)


def _to_chart(zoom: float = _ZOOM) -> NDArray[np.float64]:
    cosine, sine = np.cos(_TILT_RAD), np.sin(_TILT_RAD)
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    size = np.array(_CHART_SIZE) * zoom / _ZOOM
    return translation(*(size / 2)) @ np.diag([zoom, zoom, 1]) @ turn @ translation(-_FRAME_CENTRE[0], -_FRAME_CENTRE[1])


def _upright(image: NDArray[np.float32], zoom: float) -> NDArray[np.float32]:
    width, height = (int(side * zoom / _ZOOM) for side in _CHART_SIZE)
    return np.asarray(cv2.warpPerspective(image, _to_chart(zoom), (width, height), flags=cv2.INTER_CUBIC), np.float32)


def _profile(image: NDArray[np.float32], middle: tuple[float, float], period: float, level: bool) -> tuple[float, float]:
    """Return the mean flux of the three bars around a place, and of the two gaps between them."""
    across, along = np.arange(-1.25 * period, 1.25 * period, 0.5), np.linspace(-0.9 * period, 0.9 * period, 15)
    first, second = np.meshgrid(across, along)
    points = np.stack([second, first] if level else [first, second], axis=-1) + middle
    x, y = np.moveaxis(transform_points(np.linalg.inv(_to_chart()), points).astype(np.float32), -1, 0)
    profile = cv2.remap(image, x, y, cv2.INTER_LINEAR).mean(axis=0)
    wave = np.cos(2 * np.pi * across / period)
    return float(profile[wave > np.sqrt(0.5)].mean()), float(profile[wave < -np.sqrt(0.5)].mean())


def _contrast(image: NDArray[np.float32], middle: tuple[float, float], period: float, level: bool) -> float:
    bars, gaps = _profile(image, middle, period, level)
    return (gaps - bars) / (gaps + bars)


def _places(image: NDArray[np.float32]) -> list[tuple[tuple[float, float], ...]]:
    """Return where the bars of each element are, near where they should be, by their contrast."""
    shifts = range(-_REACH, _REACH + 1, 2)
    return [
        tuple(
            max(
                ((x + dx, y + dy) for dx in shifts for dy in shifts),
                key=lambda at, level=level, period=period: _contrast(image, at, period, level),  # type: ignore[misc]
            )
            for level, (x, y) in enumerate(middles)
        )
        for middles, period in zip(_BARS, _periods(), strict=True)
    ]


def _contrasts(image: NDArray[np.float32], places: list[tuple[tuple[float, float], ...]]) -> list[float]:
    """Return the contrast of each element, the mean of its upright and its level bars."""
    return [
        float(np.mean([_contrast(image, middle, period, bool(level)) for level, middle in enumerate(middles)]))
        for middles, period in zip(places, _periods(), strict=True)
    ]


def _periods() -> list[float]:
    return [_PERIOD * 2 ** (-element / 6) for element in range(len(_BARS))]


def _plot(contrasts: Mapping[str, Mapping[int, list[float]]]) -> draw.Picture:
    figure, (by_width, by_frames) = draw.panels(9.6, 3.6, 1, 2)
    widths = [period / _ZOOM / 2 for period in _periods()]
    for name, of_frames in contrasts.items():
        by_width.plot(widths, of_frames[_FRAMES[-1]], "o-", label=name, markersize=4)
    by_width.axhline(0, color="0.8", zorder=0)
    by_width.legend(fontsize=8)
    draw.name_axes(by_width, "width of a bar, px", f"contrast, {_FRAMES[-1]} frames")
    for element in range(0, len(_BARS), 2):
        values = [of_element[element] for of_element in contrasts["panorama"].values()]
        by_frames.plot(_FRAMES, values, "o-", label=f"{-2 + element // 6}, element {element % 6 + 1}", markersize=4)
    by_frames.set_ylim(0, 1.12)
    by_frames.legend(fontsize=8, ncols=3, loc="upper center")
    draw.name_axes(by_frames, "frames that are merged", "contrast in the panorama")
    return draw.in_bgr(figure)
