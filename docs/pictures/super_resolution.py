"""A scene that is finer than the sensor: interpolated, merged, and by super-resolution."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import tifffile
from picture_parts import beside, labelled, picture

from photonpano import open_source, parse_spec
from photonpano.captures.writing import truth_path
from photonpano.context import Context
from photonpano.evaluation.images import true_panorama
from photonpano.evaluation.inputs import load_run_trajectory, load_truth
from photonpano.evaluation.trajectory import corner_errors
from photonpano.geometry import Canvas, FrameTrajectory
from photonpano.merging.panorama import plan_canvas, render

from .captures import finish, in_folder, spec_of, written

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

FINE = {
    "version": 1,
    "source": {
        "use": "simulator",
        "with": {
            "scene": {"kind": "street", "width": 2400, "height": 1600},
            "scene_scale": 2,
            "path": {"kind": "loop", "length_px": 160, "centre": [900, 1000], "shake": {"rms_px": 0.6, "roll_rms_deg": 0.02}},
            "flux": 0.2,
            "n_frames": 6000,
            "frame_shape": [128, 160],
        },
    },
}
"""A camera whose pixels average a scene that is twice as fine."""


def pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    cube = written(parse_spec(FINE), folder / "fine.npy")
    finish(parse_spec(fine_spec(cube, "super-resolution"), output=in_folder(folder, "fine")), "super-resolution", cube)
    yield "super-resolution.png", super_resolution(folder, cube)


def fine_spec(cube: Path, renderer: str, scale: float = 2.0) -> dict[str, Any]:
    """Return the spec of the capture whose scene is finer than the sensor."""
    return spec_of(cube, render={"use": renderer, "scale": scale})


def super_resolution(folder: Path, cube: Path) -> Picture:
    """Return a part of the panorama: interpolated, merged on a fine grid, by super-resolution, and the true scene."""
    directory = in_folder(folder, "fine")
    flux, truth = tifffile.imread(directory / "panorama.tiff"), load_truth(truth_path(cube))
    found = load_run_trajectory(directory)
    canvas = Canvas(*flux.shape, found.canvas)
    assert truth.scene is not None
    alignment = corner_errors(found.homographies, truth.homographies, found.frame_shape, found.located).alignment
    scene = true_panorama(truth.scene, canvas, alignment)
    with open_source(parse_spec(fine_spec(cube, "merge"))) as source:
        trajectory, span = FrameTrajectory(found.homographies), source.info.span
        small = plan_canvas(trajectory, span, source.info.frame_shape, 1.0, 2**31)
        coarse, merged = (render(source, trajectory, span, each, 0.125, Context(2)).flux for each in (small, canvas))
    to_small = small.transform @ np.linalg.inv(canvas.transform)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    bicubic = cv2.warpPerspective(np.nan_to_num(coarse), to_small, flux.shape[::-1], flags=flags)
    middle = flux.shape[0] // 2, flux.shape[1] // 2
    part = np.s_[middle[0] - 75 : middle[0] + 75, middle[1] - 75 : middle[1] + 75]
    white = float(np.nanquantile(scene[part], 0.995))
    names = {"scale 1, interpolated": bicubic, "merge": merged, "super-resolution": flux, "true scene": scene}
    shown = {name: np.repeat(np.repeat(picture(image[part], white), 2, 0), 2, 1) for name, image in names.items()}
    return beside([labelled(image, name) for name, image in shown.items()])
