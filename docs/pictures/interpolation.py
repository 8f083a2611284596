"""The picture of the errors of interpolators between knots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import picture_parts as draw
from harness import to_reference, with_baselines
from matplotlib.axes import Axes
from numpy.typing import NDArray

from photonpano import StageContext, StreamInfo
from photonpano import geometry as g
from photonpano.capture.writing import truth_path
from photonpano.photometry import BinaryResponse

INTERPOLATORS = {
    "geodesic": ("tab:green", "-"),
    "lucas-kanade": ("black", "-"),
    "lie": ("tab:orange", "--"),
    "smoothing-spline": ("tab:blue", "-"),
}
"""Interpolators, with the colour and style of their lines."""
SPACINGS = (125, 31)  # frames between knots at the first and at the third level of the street


def interpolation(cube: Path) -> draw.Picture:
    """Return a plot of the errors between knots on the true motion of a capture, and print their means."""
    with np.load(truth_path(cube)) as file:
        truth, shape = file["homographies"], tuple(file["frame_shape"])
    truth = to_reference(truth)
    rolling = g.normalised(truth @ turned(np.linspace(0, 16 * np.pi, len(truth)), shape))
    cases = {
        f"{what}, {spacing} frames apart": (motion, spacing, error_px)
        for what, motion, error_px in (("exact", truth, 0.0), ("off by 0.1 px", truth, 0.1), ("exact, rolled", rolling, 0.0))
        for spacing in SPACINGS
    }
    figure, axes = draw.panels(10, 5.2, 2, 2, sharex=True, sharey=True)
    panels = [axes[0], axes[2], axes[1], axes[3]]  # column by column
    for place, (label, case) in enumerate(cases.items()):
        errors = {name: between_knots(name, *case, shape) for name in INTERPOLATORS}
        print(f"{label:32}", *(f"{name} {error.mean():.4f} px, worst {error.max():.3f} px;" for name, error in errors.items()))
        if place < len(panels):
            draw_errors(panels[place], f"knots {label}", case[1], errors)
    panels[0].legend(fontsize=8, ncols=2, loc="lower right")
    figure.supxlabel("frame", fontsize=9)
    figure.supylabel("corner error, px", fontsize=9)
    return draw.in_bgr(figure)


def between_knots(
    name: str, motion: NDArray[np.float64], spacing: int, error_px: float, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the mean corner error of each frame; the corners of knots have normal errors of `error_px` per coordinate."""
    instants = np.arange(spacing // 2, len(motion), spacing)
    noise = np.random.default_rng(0).normal(0, error_px, (len(instants), 8))
    to_corners = np.array([g.jacobian(knot, g.corners(shape)).reshape(8, 8) for knot in motion[instants]])
    knots = g.from_parameters(g.parameters(motion[instants]) + np.linalg.solve(to_corners, noise[..., None])[..., 0])
    contribution = with_baselines().find("interpolator", name).contribution
    context = StageContext(StreamInfo(len(motion), *shape, None), BinaryResponse())
    trajectory = contribution.build(contribution.config(), context).fit(instants.astype(float), knots, None)
    frames = np.arange(instants[0], instants[-1] + 1)
    return g.corner_displacements(trajectory.at(frames), motion[frames], shape).mean(axis=1)


def draw_errors(panel: Axes, title: str, spacing: int, errors: dict[str, NDArray[np.float64]]) -> None:
    """Draw the errors of 1,000 frames, and the positions of knots."""
    start = len(errors["lie"]) // 2
    frames = np.arange(start, start + 1000)
    for knot in frames[frames % spacing == 0]:
        panel.axvline(knot + spacing // 2, color="0.9", linewidth=0.8)
    for name, (colour, style) in INTERPOLATORS.items():
        panel.semilogy(frames + spacing // 2, errors[name][frames], style, color=colour, linewidth=1.2, label=name)
    panel.set_title(title, fontsize=9)
    panel.set_ylim(1e-4, 5)
    panel.tick_params(labelsize=8)


def turned(angles: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the maps that rotate a frame about its centre."""
    height, width = shape
    centred = g.translation((width - 1) / 2, (height - 1) / 2)
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0] = np.sin(angles)
    turns[:, 0, 1] = -turns[:, 1, 0]
    return centred @ turns @ g.inverse(centred)
