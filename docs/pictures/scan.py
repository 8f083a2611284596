"""The scan of examples/pipelines, what other specs make of it, and hot pixels; and a real capture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import picture_parts as draw
import tifffile
from harness import EXAMPLES, Study, groups

from photonpano import FrameSpan, load_panorama, load_spec, open_source, run
from photonpano.geometry import transform_points

from . import finished

WAYS = ("scan", "constant-groups", "naive-average")  # specs of examples/pipelines, for the capture beside them
PLACE = (235, 85)  # centre of the compared place, in pixels of the reference frame, which is the same for all specs


def pictures(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield each picture with its name."""
    small = {"n_frames": 1500, "frame_shape": [128, 256], "path.length_px": 200}  # as in the tutorial
    spec = study.spec("pipelines/capture", {f"source.with.{key}": value for key, value in small.items()})
    first = study.run("first", {**spec, "resample": groups(100)}, study.capture("first", spec))
    yield "first-panorama.png", draw.picture(load_panorama(first).flux, 0.67)
    capture = study.capture("capture", study.spec("pipelines/capture"))
    path = {"source.with.path": str(capture.absolute())}
    scan = study.run("scan", study.spec("pipelines/scan", path))
    yield "uncertainty.png", uncertainty(scan)
    unrefined = path | {"refine": []}  # a refiner would mend most of what the methods have lost
    runs = {name: finished(study, name, study.spec(f"pipelines/{name}", unrefined), capture) for name in WAYS}
    panoramas = {f"{name}.yaml": load_panorama(folder) for name, folder in runs.items()}
    places = {}
    for name, panorama in panoramas.items():
        x, y = transform_points(panorama.canvas, np.array([PLACE]))[0].round().astype(int)
        places[name] = draw.magnified(draw.picture(draw.around(panorama.flux, (x, y), (54, 54)), 0.67), 3)
    yield "baselines.png", draw.beside(draw.all_labelled(places))
    yield "hot-pixels.png", hot_pixels(study)


def uncertainty(folder: Path) -> draw.Picture:
    """Return the panorama of a run, its standard deviation, and the ratio of both."""
    flux, std = load_panorama(folder).flux, tifffile.imread(folder / "panorama-std.tiff")
    figure, panels = draw.panels(11, 1.9, columns=3)
    maps = {
        "flux": (flux, "gray"),
        "standard deviation": (std, "magma"),
        "flux in standard deviations": (flux / std, "viridis"),
    }
    for panel, (name, (image, colours)) in zip(panels, maps.items(), strict=True):
        shown = panel.imshow(image, colours, vmin=0, vmax=float(np.nanquantile(image, 0.97)))
        panel.set_title(name, fontsize=10)
        panel.set_axis_off()
        figure.colorbar(shown, ax=panel, shrink=0.8)
    return draw.in_bgr(figure)


def hot_pixels(study: Study) -> draw.Picture:
    """Return a place of two panoramas of a sensor with hot pixels, magnified three times: uncorrected and corrected."""
    places = {}
    for corrections in ([], ["hot-pixels"]):
        changes = {"corrections": corrections, "source.with.sensor.hot_rate": [0.5, 2]}
        flux = load_panorama(study.run("hot-pixels", study.spec("pipelines/hot-pixels", changes))).flux
        part = draw.around(flux, (flux.shape[1] // 2, flux.shape[0] // 2), (72, 54))
        places[f"corrections: [{', '.join(corrections)}]"] = draw.magnified(draw.picture(part, 0.67), 3)
    return draw.beside(draw.all_labelled(places))


def mandrill(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield a binary frame, the average of all frames, and the panorama of a real capture; print how the picture turns."""
    folder = study.folder / "mandrill"
    plan = load_spec(EXAMPLES / "pipelines" / "mandrill.yaml", output=folder)
    if not (folder / "run.json").exists():
        print(next(each for each in run(plan).record["decisions"] if each["what"] == "start"))
    with open_source(plan) as source:
        n_frames = source.info.n_frames
        frame = source.frames(FrameSpan(n_frames // 2, n_frames // 2 + 1))[0] * np.uint8(255)
        average = source.counts(source.info.span) / np.float32(n_frames)
    fluxes = average, load_panorama(folder).flux
    shown = frame, *(draw.picture(np.nan_to_num(flux).astype(np.float32), draw.white_of(flux)) for flux in fluxes)
    labels = f"one frame of {n_frames}", f"the {n_frames} frames, averaged", f"the same {n_frames} frames, as a panorama"
    yield "mandrill.png", draw.beside(draw.all_labelled(dict(zip(labels, shown, strict=True))))
