"""Fig. 9, Fig. 11 and S1: a high-speed camera, poses from averages, and bursts in one shot."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
from matplotlib.figure import Figure
from paper.figures.study import (
    Claim,
    FigureOf,
    chained,
    fails,
    fitted,
    frames_of,
    in_rows,
    motion_of,
    place,
    rounded,
    scores_of,
    scores_or_reason,
    told,
)
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

    from numpy.typing import NDArray
    from paper.figures.study import Numbers, Study
    from picture_parts import Picture

APERTURES = {"f/8": 1 / 8, "f/5.6": 1 / 4, "f/4": 1 / 2, "f/2.8": 1.0}
"""Light of each aperture, relative to the spec."""
SHOWN = ("f/5.6", "f/2.8")
"""The paper's apertures."""
METHODS = {"single": "SIFT on single frames", "SIFT": "SIFT on averages", "direct": "direct on averages"}
"""What is registered, and how."""
QUICK_CAMERA = {
    "source.with.scene": {"kind": "street", "width": 1024, "height": 682},
    "source.with.frame_shape": [128, 160],
    "source.with.path": {"kind": "pan", "length_px": 120},
    "source.with.n_frames": 60,
    "source.with.flux": 200,
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
QUICK_ROOM = {"source.with.n_frames": 300}
CAMERAS = {"conventional": 60, "high-speed": 4, "single-photon, averaged": 30}
"""Frames of an average that stand for each camera of Fig. 11."""


def high_speed(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 9: a high-speed camera over the light: single frames, averages by SIFT as in the paper, and as by default."""
    spec = study.spec("fig9", {}, QUICK_CAMERA)
    camera = spec["source"]["with"]
    numbers: Numbers = frames_of(spec) | {"read_noise": camera["sensor"]["read_noise"], "apertures": {}}
    numbers["group_size"] = spec["resample"]["with"]["group_size"]
    single = spec | {"resample": {"use": "midpoint", "with": {"group_size": 1}}, "levels": 1}
    brightest, rows = camera["flux"], []
    for name in SHOWN if study.quick else APERTURES:
        light = APERTURES[name]
        spec["source"] = {"use": "camera-simulator", "with": camera | {"flux": brightest * light}}
        truth, frame = true_and_shown(study, f"fig9-{name.replace('/', '')}", spec)
        numbers["apertures"][name] = {"photons": rounded(brightest * light)}
        shown = [labelled(picture(frame, 3 * brightest * light), f"{name}: one frame")]
        ways = {"single": chained(single), "SIFT": chained(spec), "direct": spec}
        for method in METHODS if name in SHOWN else ("SIFT", "direct"):
            each = {**ways[method], "source": spec["source"]}
            folder, scores = scores_or_reason(partial(study.run, "fig9", each), truth)
            numbers["apertures"][name][method] = scores
            error = f"{scores['mean_px']:g} px off" if folder else "not located"
            shown.append(labelled(whole(folder, frame.shape), f"{METHODS[method]}: {error}"))
        if name in SHOWN:
            rows += [beside(shown[:2]), beside(shown[2:])]
    return in_rows([*rows, high_speed_plot(numbers)]), numbers


def true_and_shown(study: Study, name: str, spec: dict[str, Any]) -> tuple[Path, NDArray[np.float32]]:
    """Write the truth of a camera, and return the name of its capture, which is simulated as it is read, and a frame."""
    capture = study.folder / f"{name}.npy"
    with open_source(parse_spec({"version": 1, "source": spec["source"]})) as source:
        assert hasattr(source, "truth")
        np.savez(truth_path(capture), **source.truth())
        middle = source.info.n_frames // 2
        return capture, source.response.flux(source.counts(FrameSpan(middle, middle + 1)).astype(np.float32), 1)


def whole(folder: Path | None, shape: tuple[int, ...]) -> Picture:
    """Return the panorama of a run as high as a frame; a grey field for no run."""
    if folder is None:
        return np.full(shape, 225, np.uint8)
    flux = load_panorama(folder).flux
    panorama = picture(flux, float(np.nanquantile(flux, 0.995)))
    scaled = fitted(panorama, round(panorama.shape[1] * shape[0] / panorama.shape[0]))
    return cv2.resize(scaled, (scaled.shape[1], shape[0])).astype(np.uint8)


def high_speed_plot(numbers: Numbers) -> Picture:
    """Plot the errors over the light."""
    figure = Figure(figsize=(9.68, 3), dpi=100, layout="constrained")
    panel = figure.subplots()
    apertures = numbers["apertures"]
    photons = [case["photons"] for case in apertures.values()]
    for method, colour in {"SIFT": "0.6", "direct": "black"}.items():
        errors = [case[method].get("mean_px", np.nan) for case in apertures.values()]
        panel.loglog(photons, errors, ".-", color=colour, label=METHODS[method])
    panel.set_xticks(photons, [f"{name}: {case['photons']:g}" for name, case in apertures.items()])
    panel.set_xticks([], minor=True)
    panel.set_xlabel("photons per pixel per frame")
    panel.set_ylabel("mean corner error (px)")
    panel.legend()
    return drawn(figure)[..., 0]


def high_speed_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 9."""
    dark, bright = (numbers["apertures"][name] for name in SHOWN)
    sift = {name: case["SIFT"] for name, case in numbers["apertures"].items()}
    averages = f"SIFT on averages of {numbers['group_size']}"
    return [
        Claim(
            "at f/5.6, frames are extremely noisy, and the reconstruction fails for lack of matches across frames",
            f"{dark['photons']:g} photons per pixel per frame, read noise of {numbers['read_noise']:g}; SIFT on single frames: "
            f"{told(dark['single'])}",
            fails(dark["single"]),
        ),
        Claim(
            "at f/2.8, with four times the light, our algorithm can reconstruct a panorama, albeit a blurry one",
            f"{bright['photons']:g} photons; {averages}: {told(bright['SIFT'])}. SIFT on single frames: "
            f"{told(bright['single'])}",
            not fails(bright["SIFT"]),
        ),
        Claim(
            "(not in the paper) the same averages in less light",
            f"{averages}: {told(dark['SIFT'])} at f/5.6; "
            + ", ".join(f"{name}: {'fails' if fails(case) else 'succeeds'}" for name, case in sift.items()),
            None,
        ),
        Claim(
            "(not in the paper) our default locator at f/5.6",
            f"direct on averages of {numbers['group_size']}: {told(dark['direct'])}",
            None,
        ),
    ]


def poses(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 11: the path of a camera that travels, from COLMAP on averages of different lengths."""
    numbers: Numbers = frames_of(study.spec("fig11", {}, QUICK_ROOM))
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
            numbers[name] |= {
                "ate_percent": rounded(100 * score.ate_share),
                "turns_deg": rounded(score.turns_deg),
                "rotation_deg": rounded(score.rotation_deg),
            }
        except PhotonpanoError as error:
            numbers[name]["reason"] = str(error).splitlines()[0]
        panel.set_title(f"{name}: {group} frames", fontsize=10)
        panel.set_xlabel("x (m)", fontsize=9)
    panels[0].set_ylabel("z (m)", fontsize=9)
    panels[0].legend(fontsize=8)
    return drawn(figure)[..., 2::-1], numbers


def poses_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 11."""

    cameras = {name: numbers[name] for name in CAMERAS}

    def measured(key: str, unit: str) -> str:
        return "; ".join(
            f"{name}, {case['group_size']} frames: " + (case.get("reason") or f"{case[key]:g} {unit}")
            for name, case in cameras.items()
        )

    def best(key: str) -> str:
        return min(cameras, key=lambda name: float(cameras[name].get(key, np.inf)))

    return [
        Claim(
            "averages of adjacent binary frames enable better poses than a high-speed or a conventional camera: positions",
            measured("ate_percent", "% of the path"),
            best("ate_percent") == "single-photon, averaged",
        ),
        Claim(
            "the same: rotations, after the best common rotation of the world",
            measured("turns_deg", "degrees"),
            best("turns_deg") == "single-photon, averaged",
        ),
        Claim(
            "the same: rotations in the world that fits the positions best, which errors of the positions turn as a whole",
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
        **frames_of(spec),
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
