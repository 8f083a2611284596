"""Figs. 7, 8 and 10: super-resolution, a large range of light, and light that flickers."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import picture_parts as draw
from harness import Compared, Study, record_of
from numpy.typing import NDArray
from paper.figures.study import (
    QUICK_STREET,
    Claim,
    Numbers,
    fails,
    frames_of,
    group_size,
    rounded,
    scores_of,
    scores_or_reason,
    told,
)

from photonpano import load_panorama
from photonpano.evaluation import covered

QUICK_FINE = {"source.with.n_frames": 2000, "source.with.frame_shape": [96, 128]}
QUICK_NIGHT = {
    "source.with.n_frames": 3000,
    "source.with.frame_shape": [128, 160],
    "source.with.scene": {"kind": "night", "width": 512, "height": 341, "range_db": 80},
    "source.with.flux": 0.5,
    "resample.with.group_size": 250,
}
QUICK_FLICKER = {
    **QUICK_STREET,
    "source.with.n_frames": 1200,
    "source.with.frame_rate_hz": 20000,
    "source.with.frame_shape": [96, 144],
    "source.with.path": {"kind": "pan", "length_px": 60},
    "source.with.flux": 0.5,
    "resample.with.group_size": 100,
}
DEPTHS = (0.0, 0.5, 0.8, 0.9, 1.0)  # amplitudes of the flicker, relative to the mean light


def fine_images(run: Compared) -> dict[str, NDArray[np.float32]]:
    """Return what a run of `super-resolution` is compared with on its canvas: interpolated, merged, and the true scene."""
    merged, bicubic = run.finer()
    return {"interpolated": bicubic, "merged": merged.flux, "fine": run.panorama.flux, "true": run.scene(run.canvas)}


def fine_pictures(images: dict[str, NDArray[np.float32]], radius: tuple[int, int]) -> draw.Picture:
    """Return the middle of images, magnified twice; the last one has the white."""
    parts = {name: draw.around(image, (image.shape[1] // 2, image.shape[0] // 2), radius) for name, image in images.items()}
    white = draw.white_of(list(parts.values())[-1])
    return draw.beside([draw.labelled(draw.magnified(draw.picture(part, white), 2), name) for name, part in parts.items()])


def super_resolution(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 7: a part of the panorama, interpolated from the resolution of the sensor, super-resolved, and the truth."""
    spec = study.spec("paper/fig7", {}, QUICK_FINE)
    capture = study.capture("fig7", spec)
    run = Compared.of(study.run("fig7", spec, capture), capture)
    of = fine_images(run)
    seen = covered(run.panorama.weight) & np.isfinite(of["true"])
    compared = cv2.erode(seen.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    numbers = {**frames_of(spec), "scale": spec["render"]["scale"]}
    for name, image in {"interpolated_psnr_db": of["interpolated"], "psnr_db": of["fine"]}.items():
        numbers[name] = round(run.psnr_db(image, of["true"], compared), 1)
    named = {"sensor's resolution, interpolated": of["interpolated"], "super-resolution, 2x": of["fine"]}
    return fine_pictures({**named, "true scene": of["true"]}, (80, 75)), numbers


def super_resolution_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 7."""
    return [
        Claim(
            "the sensor's native resolution is super-resolved by 2x: text and fine structures",
            f"PSNR {numbers['psnr_db']:.1f} dB at {numbers['scale']}x, {numbers['interpolated_psnr_db']:.1f} dB interpolated "
            f"from the sensor's resolution",
            numbers["psnr_db"] > numbers["interpolated_psnr_db"] + 1,
        )
    ]


def dynamic_range(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 8: the average of all frames, and the stabilised image."""
    spec = study.spec("paper/fig8", {}, QUICK_NIGHT)
    capture = study.capture("fig8", spec)
    run = Compared.of(study.run("fig8", spec, capture), capture)
    with run.source() as source:
        n_frames = source.info.n_frames
        average = source.response.flux(source.counts(source.info.span).astype(np.float32) / n_frames, n_frames)
    flux = run.panorama.flux
    white = float(np.nanquantile(flux, 0.98))
    shown = {
        f"the {n_frames:,} frames, averaged": draw.picture(average, white),
        "aligned and merged": draw.picture(flux, white),
    }
    local = cv2.imread(str(run.folder / "panorama.png"), cv2.IMREAD_GRAYSCALE)
    shown["the same, all of its range (tone: local)"] = np.asarray(local, np.uint8)
    panorama = record_of(run.folder)["panorama"]
    numbers = {
        **frames_of(spec, "flux"),
        "median_flux": rounded(float(np.nanmedian(flux)), 2),
        "shake_px": spec["source"]["with"]["path"]["shake"]["rms_px"],
        "range_db": round(panorama["dynamic_range_db"]),
        "measurable_db": round(panorama["measurable_range_db"]),
        **scores_of(run.folder, capture),
    }
    return draw.beside(draw.all_labelled(shown)), numbers


def range_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 8."""
    return [
        Claim(
            "extremely dark frames are aligned, and camera shake is stabilised",
            f"{numbers['n_frames']:,} frames with a median flux of {numbers['median_flux']:g}, and a shake of "
            f"{numbers['shake_px']:g} px: mean corner error {numbers['mean_px']:g} px",
            numbers["mean_px"] < 1,
        ),
        Claim(
            "detail is recovered in both dark and bright regions",
            f"{numbers['range_db']} dB above noise, of {numbers['measurable_db']} dB that the frames can measure",
            numbers["range_db"] > 60,
        ),
    ]


def flicker(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 10: errors over the depth of the flicker with the light taken for steady, and panoramas where the lamps go out."""
    spec = study.spec("paper/fig10", {}, QUICK_FLICKER)
    (lamp,) = spec["source"]["with"]["lamps"]
    numbers: Numbers = frames_of(spec) | {"frequency_hz": lamp["frequency_hz"]}
    numbers["group_periods"] = rounded(group_size(spec) * lamp["frequency_hz"] / numbers["frame_rate_hz"], 2)
    numbers["depths"] = list(DEPTHS[::4] if study.quick else DEPTHS)
    steady = spec | {"light": "steady"}
    found = [under(study, steady, [lamp | {"depth": depth}]) for depth in numbers["depths"]]
    measured = under(study, spec, [lamp])
    phases = [
        lamp | {"phase_deg": degrees, "at": [x, 0.5], "radius": 0.25} for degrees, x in ((0, 0.35), (120, 0.5), (-120, 0.65))
    ]
    numbers["steady"] = [scores for _, scores in found]
    numbers |= {"auto": measured[1], "phases": under(study, steady, phases)[1]}
    runs = {"the lamps go out; light taken for steady": found[-1][0], "the same, light measured": measured[0]}
    shown = draw.all_labelled(
        {name: draw.picture(load_panorama(folder).flux) for name, folder in runs.items() if folder is not None}
    )
    figure, (panel,) = draw.panels(8, 2.6)
    errors = [scores.get("mean_px", np.nan) for scores in numbers["steady"]]
    panel.semilogy(numbers["depths"], errors, ".-", color="0.6", label="light taken for steady")
    panel.semilogy([lamp["depth"]], [numbers["auto"].get("mean_px", np.nan)], "o", color="black", label="light measured")
    draw.name_axes(panel, "depth of the flicker (1: the lamps go out)", "mean corner error (px)", None)
    panel.legend()
    return draw.in_rows([*shown, draw.drawn(figure)[..., 0]]), numbers


def under(study: Study, spec: dict[str, Any], lamps: list[dict[str, Any]]) -> tuple[Path | None, Numbers]:
    """Return the run under lamps and its scores, or no run and the reason."""
    spec = spec | {"source": {**spec["source"], "with": spec["source"]["with"] | {"lamps": lamps}}}
    capture = study.capture("fig10", spec)
    return scores_or_reason(partial(study.run, "fig10", spec, capture), capture)


def flicker_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 10."""
    *shallow, out = zip(numbers["depths"], numbers["steady"], strict=True)
    return [
        Claim(
            "flicker of artificial light violates brightness constancy, and the reconstruction fails",
            f"all lamps go out at {numbers['frequency_hz']:g} Hz, groups of {numbers['group_periods']:g} periods: "
            f"{told(out[1])}",
            fails(out[1]),
        ),
        Claim(
            "(not in the paper) how deep the flicker is when it fails",
            "; ".join(f"depth {depth:g}: {told(scores)}" for depth, scores in shallow),
        ),
        Claim(
            "(not in the paper) lamps that go out on three phases, so that it is never dark everywhere",
            told(numbers["phases"]),
        ),
        Claim(
            "may be mitigated (by longer exposures where brightness is not constant)",
            f"by measuring the light: {told(numbers['auto'])}",
            fails(out[1]) and not fails(numbers["auto"]),
        ),
    ]
