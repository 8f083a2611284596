"""A camera that trembles: the spectra of what is left of its motion, and videos of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from picture_parts import GAP, beside, drawn, stacked

from photonpano import open_source, parse_spec, video
from photonpano.context import Context
from photonpano.merging.panorama import plan_canvas, render
from photonpano.report.residual_figures import spectrum_over_noise
from photonpano.residuals.measure import measure
from photonpano.residuals.prediction import Predictions

from .captures import finish, in_folder, motion, spec_of, written

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

TREMOR = {
    "version": 1,
    "source": {
        "use": "simulator",
        "with": {
            "scene": {"kind": "street", "width": 1024, "height": 682},
            "path": {
                "kind": "pan",
                "length_px": 100,
                "angle_deg": 10,
                "shake": {"rms_px": 1.0, "frequencies_hz": [223, 590, 1270]},
            },
            "flux": 0.2,
            "n_frames": 6000,
            "frame_shape": [160, 240],
        },
    },
}
"""The camera trembles faster than groups of 180 frames."""
REFINERS = {"without": ("tab:orange", "[]"), "with": ("tab:blue", "short-spans")}
"""Runs without and with the refiner, with the colours of their lines."""


def pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    cube = written(parse_spec(TREMOR), folder / "tremor.npy")
    for name, (_, refiner) in REFINERS.items():
        plan = parse_spec(tremor_spec(cube), overrides=[f"refine={refiner}"], output=in_folder(folder, f"tremor {name}"))
        finish(plan, f"tremor {name}", cube)
    yield "tremor.png", tremor(folder, cube)
    yield "video.png", video_pictures(in_folder(folder, "tremor with"), folder)


def tremor_spec(cube: Path) -> dict[str, Any]:
    """Return a spec whose groups are longer than the periods of the tremor."""
    return spec_of(cube, resample={"with": {"group_size": 180}})


def tremor(folder: Path, cube: Path) -> Picture:
    """Return a plot of the spectra of the shifts of short spans against the panorama."""
    figure = Figure(figsize=(10, 3.2), dpi=100, layout="constrained")
    panel = figure.subplots()
    with open_source(parse_spec(tremor_spec(cube))) as source:
        span, shape = source.info.span, source.info.frame_shape
        for name, (colour, _) in REFINERS.items():
            trajectory = motion(in_folder(folder, f"tremor {name}"))
            canvas = plan_canvas(trajectory, span, shape, 1.0, 2**30)
            panorama = render(source, trajectory, span, canvas, 0.25, Context())
            residuals = measure(span, Predictions.of(source, panorama, canvas, trajectory, shape), Context())
            frequencies, power = spectrum_over_noise(residuals)
            panel.semilogy(96_800 * frequencies, power, color=colour, linewidth=1.2, label=f"{name} the refiner short-spans")
    panel.axhline(1, color="0.5", linewidth=0.8, linestyle="--")
    panel.set_xlim(0, 3000)
    panel.set_xlabel("frequency (Hz)", fontsize=9)
    panel.set_ylabel("power / noise", fontsize=9)
    panel.tick_params(labelsize=8)
    panel.legend(fontsize=8)
    return drawn(figure)[..., 2::-1]


def video_pictures(run_folder: Path, folder: Path) -> Picture:
    """Return three pictures of a video in the plane of the panorama, above three that follow the camera."""
    rows = []
    for view, extent in (("panorama", "panorama"), ("smooth", [12, 12, 228, 148])):
        directory = folder / f"video-{view}"
        if not directory.exists():
            video(run_folder, directory, view=view, exposure=100, trail=view == "panorama", changes=[f"render.extent={extent}"])
        files = sorted(directory.iterdir())
        shown = [cv2.imread(str(files[place]), cv2.IMREAD_GRAYSCALE) for place in (0, len(files) // 2, -1)]
        rows.append(beside(shown))
    width = max(row.shape[1] for row in rows)
    gap = np.full((GAP, width), 255, np.uint8)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1])), constant_values=255) for row in rows]
    return stacked([padded[0], gap, padded[1]])
