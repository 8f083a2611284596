"""Figs. 7, 8 and 10: super-resolution, a large range of light, and light that flickers."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
from matplotlib.figure import Figure
from paper.figures.study import (
    Claim,
    FigureOf,
    fails,
    frames_of,
    in_rows,
    motion_of,
    record_of,
    rounded,
    scores_of,
    scores_or_reason,
    told,
)
from picture_parts import beside, drawn, labelled, picture

from photonpano import load_panorama, open_source, parse_spec
from photonpano.context import Context
from photonpano.evaluation import covered, image_score, true_panorama, white_flux
from photonpano.geometry import Canvas, FrameTrajectory
from photonpano.merging.panorama import plan_canvas, render

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from paper.figures.study import Numbers, Study
    from picture_parts import Picture

QUICK_FINE = {"source.with.n_frames": 2000, "source.with.frame_shape": [96, 128]}
QUICK_NIGHT = {
    "source.with.n_frames": 3000,
    "source.with.frame_shape": [128, 160],
    "source.with.scene": {"kind": "night", "width": 512, "height": 341, "range_db": 80},
    "source.with.flux": 0.5,
    "resample.with.group_size": 250,
}
QUICK_FLICKER = {
    "source.with.n_frames": 1200,
    "source.with.frame_rate_hz": 20000,
    "source.with.frame_shape": [96, 144],
    "source.with.scene": {"kind": "street", "width": 1024, "height": 682},
    "source.with.path": {"kind": "pan", "length_px": 60},
    "source.with.flux": 0.5,
    "resample.with.group_size": 100,
}
DEPTHS = (0.0, 0.5, 0.8, 0.9, 1.0)
"""Amplitudes of the flicker, relative to the mean light."""


def super_resolution(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 7: a part of the panorama, interpolated from the resolution of the sensor, super-resolved, and the truth."""
    spec = study.spec("fig7", {}, QUICK_FINE)
    capture = study.capture("fig7", spec)
    folder = study.run("fig7", spec, capture)
    fine = load_panorama(folder)
    canvas = Canvas(*fine.flux.shape[:2], fine.canvas)
    found, truth, score = motion_of(folder, capture)
    assert truth.scene is not None
    scene = true_panorama(truth.scene, canvas, score.alignment)
    with open_source(parse_spec(record_of(folder)["spec"])) as source:
        trajectory, span = FrameTrajectory(found.homographies), source.info.span
        small = plan_canvas(trajectory, span, source.info.frame_shape, 1.0, 2**31)
        coarse = render(source, trajectory, span, small, 0.125, Context(2)).flux
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    to_small = small.transform @ np.linalg.inv(canvas.transform)
    bicubic = cv2.warpPerspective(np.nan_to_num(coarse), to_small, fine.flux.shape[::-1], flags=flags)
    compared = cv2.erode((covered(fine.weight) & np.isfinite(scene)).astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    white = white_flux(truth.scene)
    middle = fine.flux.shape[0] // 2, fine.flux.shape[1] // 2
    part = np.s_[middle[0] - 75 : middle[0] + 75, middle[1] - 80 : middle[1] + 80]
    bright = float(np.nanquantile(scene[part], 0.995))
    images = {"sensor's resolution, interpolated": bicubic, "super-resolution, 2x": fine.flux, "true scene": scene}
    shown = [labelled(np.kron(picture(image[part], bright), np.ones((2, 2), np.uint8)), name) for name, image in images.items()]
    numbers = {
        **frames_of(spec),
        "scale": spec["render"]["scale"],
        "interpolated_psnr_db": round(image_score(bicubic, scene, compared, white).psnr_db, 1),
        "psnr_db": round(image_score(fine.flux, scene, compared, white).psnr_db, 1),
    }
    return beside(shown), numbers


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


def dynamic_range(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 8: the average of all frames, and the stabilised image."""
    spec = study.spec("fig8", {}, QUICK_NIGHT)
    capture = study.capture("fig8", spec)
    folder = study.run("fig8", spec, capture)
    with open_source(parse_spec(record_of(folder)["spec"])) as source:
        n_frames = source.info.n_frames
        average = source.response.flux(source.counts(source.info.span).astype(np.float32) / n_frames, n_frames)
    flux = load_panorama(folder).flux
    white = float(np.nanquantile(flux, 0.98))
    shown = {f"the {n_frames:,} frames, averaged": picture(average, white), "aligned and merged": picture(flux, white)}
    local = cv2.imread(str(folder / "panorama.png"), cv2.IMREAD_GRAYSCALE)
    shown["the same, all of its range (tone: local)"] = np.asarray(local, np.uint8)
    panorama = record_of(folder)["panorama"]
    numbers = {
        **frames_of(spec),
        "flux": spec["source"]["with"]["flux"],
        "median_flux": rounded(float(np.nanmedian(flux)), 2),
        "shake_px": spec["source"]["with"]["path"]["shake"]["rms_px"],
        "range_db": round(panorama["dynamic_range_db"]),
        "measurable_db": round(panorama["measurable_range_db"]),
        **scores_of(folder, capture),
    }
    return beside([labelled(image, label) for label, image in shown.items()]), numbers


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


def flicker(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 10: errors over the depth of the flicker with the light taken for steady, and panoramas where the lamps go out."""
    spec = study.spec("fig10", {}, QUICK_FLICKER)
    (lamp,) = spec["source"]["with"]["lamps"]
    group = spec["resample"]["with"]["group_size"]
    numbers: Numbers = frames_of(spec) | {
        "frequency_hz": lamp["frequency_hz"],
        "group_periods": rounded(group * lamp["frequency_hz"] / spec["source"]["with"]["frame_rate_hz"], 2),
        "depths": list(DEPTHS[::4] if study.quick else DEPTHS),
    }
    steady = spec | {"light": "steady"}
    found = [under(study, steady, [lamp | {"depth": depth}]) for depth in numbers["depths"]]
    measured = under(study, spec, [lamp])
    phases = [
        lamp | {"phase_deg": degrees, "at": [x, 0.5], "radius": 0.25} for degrees, x in ((0, 0.35), (120, 0.5), (-120, 0.65))
    ]
    numbers |= {
        "steady": [scores for _, scores in found],
        "auto": measured[1],
        "phases": under(study, steady, phases)[1],
    }
    shown = []
    for (folder, _), name in ((found[-1], "the lamps go out; light taken for steady"), (measured, "the same, light measured")):
        if folder is not None:
            flux = load_panorama(folder).flux
            shown.append(labelled(picture(flux, float(np.nanquantile(flux, 0.995))), name))
    figure = Figure(figsize=(8, 2.6), dpi=100, layout="constrained")
    panel = figure.subplots()
    errors = [scores.get("mean_px", np.nan) for scores in numbers["steady"]]
    panel.semilogy(numbers["depths"], errors, ".-", color="0.6", label="light taken for steady")
    panel.semilogy([lamp["depth"]], [numbers["auto"].get("mean_px", np.nan)], "o", color="black", label="light measured")
    panel.set_xlabel("depth of the flicker (1: the lamps go out)")
    panel.set_ylabel("mean corner error (px)")
    panel.legend()
    return in_rows([*shown, drawn(figure)[..., 0]]), numbers


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
            None,
        ),
        Claim(
            "(not in the paper) lamps that go out on three phases, so that it is never dark everywhere",
            told(numbers["phases"]),
            None,
        ),
        Claim(
            "may be mitigated (by longer exposures where brightness is not constant)",
            f"by measuring the light: {told(numbers['auto'])}",
            fails(out[1]) and not fails(numbers["auto"]),
        ),
    ]


FIG7 = FigureOf(super_resolution, super_resolution_claims)
FIG8 = FigureOf(dynamic_range, range_claims)
FIG10 = FigureOf(flicker, flicker_claims)
