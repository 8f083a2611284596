"""A camera that trembles: the spectra of what is left of its motion, and videos of a run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import picture_parts as draw
from harness import Compared, Study, groups, packed, rendered, simulator

from photonpano import video
from photonpano.execution.context import Context
from photonpano.geometry import Canvas
from photonpano.report.figures import spectrum_over_noise
from photonpano.residuals.measure import measure
from photonpano.residuals.prediction import Predictions

from . import finished

TREMOR = simulator(
    scene={"kind": "street", "width": 1024, "height": 682},
    path={"kind": "pan", "length_px": 100, "angle_deg": 10, "shake": {"rms_px": 1.0, "frequencies_hz": [223, 590, 1270]}},
    flux=0.2,
    n_frames=6000,
    frame_shape=[160, 240],
)
"""The camera trembles faster than groups of 180 frames."""
REFINERS = {"without": ("tab:orange", []), "with": ("tab:blue", "short-spans")}
"""Runs without and with the refiner, with the colours of their lines."""


def pictures(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield each picture with its name."""
    cube = study.capture("tremor", TREMOR)
    runs = {}
    for name, (_, refiner) in REFINERS.items():
        spec = packed(cube, resample={"with": groups(180)["with"]}, refine=refiner)
        runs[name] = Compared.of(finished(study, f"tremor {name}", spec, cube), cube)
    yield "tremor.png", tremor(runs)
    yield "video.png", video_pictures(runs["with"].folder, study.folder)


def tremor(runs: dict[str, Compared]) -> draw.Picture:
    """Return a plot of the spectra of the shifts of short spans against the panorama."""
    figure, (panel,) = draw.panels(10, 3.2)
    for name, (colour, _) in REFINERS.items():
        run = runs[name]
        with run.source() as source:
            panorama = rendered(source, run.motion, tolerance_px=0.25)
            canvas = Canvas(*panorama.flux.shape, panorama.canvas)
            predictions = Predictions.of(source, panorama, canvas, run.motion, source.info.frame_shape)
            frequencies, power = spectrum_over_noise(measure(source.info.span, predictions, Context()))
        panel.semilogy(96_800 * frequencies, power, color=colour, linewidth=1.2, label=f"{name} the refiner short-spans")
    panel.axhline(1, color="0.5", linewidth=0.8, linestyle="--")
    panel.set_xlim(0, 3000)
    draw.name_axes(panel, "frequency (Hz)", "power / noise")
    panel.tick_params(labelsize=8)
    panel.legend(fontsize=8)
    return draw.in_bgr(figure)


def video_pictures(run_folder: Path, folder: Path) -> draw.Picture:
    """Return three pictures of a video in the plane of the panorama, above three that follow the camera."""
    rows = []
    for view, extent in (("panorama", "panorama"), ("smooth", [12, 12, 228, 148])):
        directory = folder / f"video-{view}"
        if not directory.exists():
            video(run_folder, directory, view=view, exposure=100, trail=view == "panorama", changes=[f"render.extent={extent}"])
        files = sorted(directory.iterdir())
        shown = [cv2.imread(str(files[place]), cv2.IMREAD_GRAYSCALE) for place in (0, len(files) // 2, -1)]
        rows.append(draw.beside(shown))
    return draw.in_rows(rows)
