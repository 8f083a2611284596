"""Fig. 9, Fig. 11 and S1: a high-speed camera, poses from averages, and bursts in one shot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from matplotlib.figure import Figure
from paper.figures.study import Claim, FigureOf, fitted, in_rows, motion_of, place, rounded, scores_of
from picture_parts import beside, drawn, labelled, picture

from photonpano import FrameSpan, Panorama, PhotonpanoError, evaluate_poses, load_panorama, open_source, parse_spec
from photonpano.captures.writing import truth_path
from photonpano.evaluation import align_positions, corner_errors, image_score, true_panorama, white_flux
from photonpano.geometry import FrameTrajectory, apply
from photonpano.merging.panorama import plan_canvas
from photonpano.poses import centres

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from paper.figures.study import Numbers, Study
    from picture_parts import Picture

APERTURES = {"f/5.6": 0.25, "f/2.8": 1.0}
"""Light of each aperture, relative to the spec."""
QUICK_CAMERA = {
    "source.with.scene": {"kind": "street", "width": 1024, "height": 682},
    "source.with.frame_shape": [128, 160],
    "source.with.path": {"kind": "pan", "length_px": 120},
    "source.with.n_frames": 60,
}
QUICK_BURST = {
    "source.with.path": {"kind": "random-spline", "length_px": 60, "shake": {"rms_px": 1.5, "frequencies_hz": [250, 600]}},
    "source.with.scene": {"kind": "street", "width": 512, "height": 341},
    "source.with.n_frames": 1200,
    "source.with.frame_shape": [96, 128],
    "source.with.flux": 0.5,
    "resample.with.group_size": 100,
    "merge.with.block_frames": 20,
}
QUICK_ROOM = {"source.with.n_frames": 360}
CAMERAS = {"conventional": 60, "high-speed": 4, "single-photon, averaged": 30}
"""Frames of an average that stand for each camera of Fig. 11."""


def high_speed(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 9: a frame and the panorama of a high-speed camera, in two levels of light."""
    numbers: Numbers = {}
    rows = []
    for name, light in APERTURES.items():
        spec = study.spec("fig9", {}, QUICK_CAMERA)
        spec["source"]["with"]["flux"] *= light
        source_only = {"version": 1, "source": spec["source"]}
        with open_source(parse_spec(source_only)) as source:
            assert hasattr(source, "truth")
            middle = source.info.n_frames // 2
            frame = source.response.flux(source.counts(FrameSpan(middle, middle + 1)).astype(np.float32), 1)
            truth = truth_path(study.folder / f"fig9-{name.replace('/', '')}.npy")
            np.savez(truth, **source.truth())
        white = 3 * spec["source"]["with"]["flux"]
        shown = [labelled(picture(frame, white), f"{name}: one frame")]
        numbers[name] = {"photons": rounded(spec["source"]["with"]["flux"]), "frames": spec["source"]["with"]["n_frames"]}
        try:
            folder = study.run(f"fig9-{name.replace('/', '')}", spec)
            flux = load_panorama(folder).flux
            panorama = picture(flux, float(np.nanquantile(flux, 0.995)))
            shown.append(labelled(fitted(panorama, round(panorama.shape[1] * frame.shape[0] / panorama.shape[0])), "panorama"))
            numbers[name] |= scores_of(folder, truth.with_name(truth.name.replace(".truth.npz", ".npy")))
        except PhotonpanoError as error:
            numbers[name]["reason"] = str(error).splitlines()[0]
        rows.append(beside(shown))
    return in_rows(rows), numbers


def high_speed_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 9."""

    def measured(case: Numbers) -> str:
        found = case.get("reason") or f"mean corner error {case['mean_px']:g} px, PSNR {case['psnr_db']:.1f} dB"
        return f"{case['frames']} frames with {case['photons']:g} photons per pixel: {found}"

    dark, bright = (numbers[name] for name in APERTURES)
    return [
        Claim("at f/5.6, frames are extremely noisy, and the reconstruction fails", measured(dark), "reason" in dark),
        Claim(
            "at f/2.8, with four times the light, a panorama can be reconstructed, albeit a blurry one",
            measured(bright),
            "reason" not in bright,
        ),
    ]


def poses(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 11: the path of a camera that travels, from COLMAP on averages of different lengths."""
    numbers: Numbers = {}
    figure = Figure(figsize=(9.68, 3.4), dpi=100, layout="constrained")
    panels = figure.subplots(1, len(CAMERAS), sharex=True, sharey=True)
    for panel, (name, group) in zip(panels, CAMERAS.items(), strict=True):
        spec = study.spec("fig11", {}, QUICK_ROOM)
        spec["pose"] = {"use": "colmap-averages", "with": {"group_size": group}}
        capture = study.capture("fig11", spec)
        with np.load(truth_path(capture)) as file:
            true = centres(file["camera_from_world"])
        panel.plot(true[:, 0], true[:, 2], color="black", linewidth=3, alpha=0.25, label="true")
        numbers[name] = {"group_size": group}
        try:
            folder = study.run(f"fig11-{group}", spec, capture)
            score = evaluate_poses(folder, truth_path(capture))
            found = centres(np.load(folder / "poses.npz")["camera_from_world"])
            scale, rotation, shift = align_positions(found, true)
            aligned = scale * found @ rotation.T + shift
            panel.plot(aligned[:, 0], aligned[:, 2], color="tab:blue", linewidth=1, label="found")
            numbers[name] |= {"ate_percent": rounded(100 * score.ate_share), "rotation_deg": rounded(score.rotation_deg)}
        except PhotonpanoError as error:
            numbers[name]["reason"] = str(error).splitlines()[0]
        panel.set_title(f"{name}: {group} frames", fontsize=10)
        panel.set_xlabel("x (m)", fontsize=9)
    panels[0].set_ylabel("z (m)", fontsize=9)
    panels[0].legend(fontsize=8)
    return drawn(figure)[..., 2::-1], numbers


def poses_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 11."""

    def measured(key: str, unit: str) -> str:
        return "; ".join(
            f"{name}, {case['group_size']} frames: " + (case.get("reason") or f"{case[key]:g} {unit}")
            for name, case in numbers.items()
        )

    def best(key: str) -> str:
        return min(numbers, key=lambda name: float(numbers[name].get(key, np.inf)))

    return [
        Claim(
            "averages of adjacent binary frames enable better poses than a high-speed or a conventional camera: positions",
            measured("ate_percent", "% of the path"),
            best("ate_percent") == "single-photon, averaged",
        ),
        Claim(
            "the same: rotations",
            measured("rotation_deg", "degrees"),
            best("rotation_deg") == "single-photon, averaged",
        ),
    ]


def bursts(study: Study) -> tuple[Picture, Numbers]:
    """S1: bursts that are aligned once and stitched, and two levels of ours with groups of the same size."""
    spec = study.spec("s1", {}, QUICK_BURST)
    capture = study.capture("s1", spec)
    burst, burst_db = stitched_exposures(study.run("s1", spec, capture), capture)
    ours_spec: dict[str, Any] = {key: value for key, value in spec.items() if key not in ("merge", "output")}
    folder = study.run("s1-ours", ours_spec | {"levels": [{"scale": 1}] * 2}, capture)
    ours = load_panorama(folder)
    found = motion_of(folder, capture)[0]
    x, y = apply(found.homographies[len(found.homographies) // 2], (np.array([found.frame_shape[::-1]]) - 1) / 2)[0]
    white = float(np.nanquantile(ours.flux, 0.995))
    names = {"bursts in one pass, stitched": burst, "ours, two levels": ours}
    height, width = np.min([panorama.flux.shape for panorama in names.values()], axis=0)
    radius = min(110, int(width) // 2), min(80, int(height) // 2)
    shown = [labelled(place(panorama, (x, y), radius, white), name) for name, panorama in names.items()]
    return beside(shown), {
        "group_size": spec["resample"]["with"]["group_size"],
        "n_frames": spec["source"]["with"]["n_frames"],
        "one_pass_psnr_db": round(burst_db, 1),
        "ours": scores_of(folder, capture),
    }


def stitched_exposures(folder: Path, capture: Path) -> tuple[Panorama, float]:
    """Return the mean of the exposures of a run of one level, each placed where it was located, and its PSNR in dB."""
    found, truth, _ = motion_of(folder, capture)
    exposures = np.load(folder / "exposures" / "level-1.npy")
    with np.load(folder / "exposures" / "level-1.npz") as level:
        homographies, instants = level["homographies"], level["instants"].round().astype(int)
    alignment = corner_errors(homographies, truth.homographies[instants], found.frame_shape).alignment
    canvas = plan_canvas(FrameTrajectory(homographies), FrameSpan(0, len(homographies)), found.frame_shape, 1.0, 2**31)
    total, weight = (np.zeros(canvas.shape, np.float32) for _ in range(2))
    for flux, to_reference in zip(exposures, homographies, strict=True):
        to_canvas, size = canvas.transform @ to_reference, (canvas.width, canvas.height)
        total += cv2.warpPerspective(np.nan_to_num(flux), to_canvas, size)
        weight += cv2.warpPerspective(np.isfinite(flux).astype(np.float32), to_canvas, size)
    seen = weight > 0.5
    panorama = np.where(seen, total / np.maximum(weight, 0.5), np.float32(np.nan))
    assert truth.scene is not None
    scene = true_panorama(truth.scene, canvas, alignment)
    psnr_db = image_score(panorama, scene, seen & np.isfinite(scene), white_flux(truth.scene)).psnr_db
    return Panorama(panorama, weight, canvas.transform), psnr_db


def bursts_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of S1."""
    ours = numbers["ours"]
    return [
        Claim(
            "a burst in one pass cannot fully compensate fast vibrations; two iterations of ours, with groups of the same "
            "size, are sharper",
            f"groups of {numbers['group_size']:,} of {numbers['n_frames']:,} frames: PSNR {numbers['one_pass_psnr_db']:.1f} dB "
            f"of the stitched bursts, {ours['psnr_db']:.1f} dB of ours",
            ours["psnr_db"] > numbers["one_pass_psnr_db"] + 1,
        )
    ]


HIGH_SPEED = FigureOf(high_speed, high_speed_claims)
POSES = FigureOf(poses, poses_claims)
BURSTS = FigureOf(bursts, bursts_claims)
