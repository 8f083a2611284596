"""Figs. 7, 8 and 10: super-resolution, a large range of light, and light that flickers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from paper.figures.study import Claim, FigureOf, in_rows, motion_of, record_of, rounded, scores_of
from picture_parts import beside, labelled, picture

from photonpano import PhotonpanoError, load_panorama, open_source, parse_spec
from photonpano.context import Context
from photonpano.evaluation import covered, image_score, true_panorama, white_flux
from photonpano.geometry import Canvas, FrameTrajectory
from photonpano.merging.panorama import plan_canvas, render

if TYPE_CHECKING:
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
    "source.with.frame_shape": [96, 144],
    "source.with.scene": {"kind": "street", "width": 1024, "height": 682},
    "source.with.path": {"kind": "pan", "length_px": 60},
    "source.with.flux": 0.5,
}


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
        "n_frames": spec["source"]["with"]["n_frames"],
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
        "n_frames": n_frames,
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
    """Fig. 10: the panorama of a capture whose light flickers, taken for steady, and measured."""
    shown, numbers = [], {}
    for name, light in {"light taken for steady": "steady", "light measured": "auto"}.items():
        spec = study.spec("fig10", {"light": light}, QUICK_FLICKER)
        capture = study.capture("fig10", spec)
        lamp = spec["source"]["with"]["lamps"][0]
        numbers |= {
            "frequency_hz": lamp["frequency_hz"],
            "depth": lamp["depth"],
            "n_frames": spec["source"]["with"]["n_frames"],
        }
        try:
            folder = study.run("fig10", spec, capture)
        except PhotonpanoError as error:
            numbers[light] = {"reason": str(error).splitlines()[0]}
            continue
        flux = load_panorama(folder).flux
        shown.append(labelled(picture(flux, float(np.nanquantile(flux, 0.995))), name))
        numbers[light] = scores_of(folder, capture)
    return in_rows(shown), numbers


def flicker_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 10."""
    steady, measured = numbers["steady"], numbers["auto"]
    fails = steady.get("reason") or (
        f"mean corner error {steady['mean_px']:g} px, largest {steady['worst_px']:g} px, PSNR {steady['psnr_db']:.1f} dB"
    )
    return [
        Claim(
            "flicker of artificial light violates brightness constancy, and the reconstruction fails",
            f"lamps at {numbers['frequency_hz']:g} Hz that go out: {fails}",
            "reason" in steady or steady["mean_px"] > 1,
        ),
        Claim(
            "may be mitigated (by longer exposures where brightness is not constant)",
            f"by measuring the light: mean corner error {measured['mean_px']:g} px, largest {measured['worst_px']:g} px, "
            f"PSNR {measured['psnr_db']:.1f} dB",
            measured["mean_px"] < steady.get("mean_px", np.inf) / 2,
        ),
    ]


FIG7 = FigureOf(super_resolution, super_resolution_claims)
FIG8 = FigureOf(dynamic_range, range_claims)
FIG10 = FigureOf(flicker, flicker_claims)
