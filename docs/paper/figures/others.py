"""Fig. 9, Fig. 11 and S1: a high-speed camera, poses from averages, and bursts in one shot."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import picture_parts as draw
from harness import Compared, Study, simulator
from matplotlib.axes import Axes
from numpy.typing import NDArray
from paper.figures.study import (
    QUICK_STREET,
    Claim,
    Numbers,
    chained,
    fails,
    first_exposures,
    frames_of,
    group_size,
    reason_of,
    rounded,
    scores_of,
    scores_or_reason,
    told,
)

from photonpano import FrameSpan, Panorama, PhotonpanoError, load_panorama, open_source, parse_spec
from photonpano.capture.writing import truth_path
from photonpano.geometry import FrameTrajectory, positions_of
from photonpano.merging.panorama import plan_canvas
from photonpano_poses import align_positions, evaluate_poses

APERTURES = {"f/8": 1 / 8, "f/5.6": 1 / 4, "f/4": 1 / 2, "f/2.8": 1.0}  # and their light, relative to the spec
SHOWN = ("f/5.6", "f/2.8")  # the paper's apertures
METHODS = {"single": "SIFT on single frames", "SIFT": "SIFT on averages", "direct": "direct on averages"}
QUICK_CAMERA = {
    **QUICK_STREET,
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


def high_speed(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 9: a high-speed camera over the light: single frames, averages by SIFT as in the paper, and as by default."""
    spec = study.spec("paper/fig9", {}, QUICK_CAMERA)
    camera = spec["source"]["with"]
    numbers: Numbers = frames_of(spec) | {"read_noise": camera["sensor"]["read_noise"], "apertures": {}}
    numbers["group_size"] = group_size(spec)
    single = spec | {"resample": {"use": "midpoint", "with": {"group_size": 1}}, "levels": 1}
    ways = {"single": chained(single), "SIFT": chained(spec), "direct": spec}
    brightest, rows = camera["flux"], []
    for name in SHOWN if study.quick else APERTURES:
        photons = brightest * APERTURES[name]
        seen = simulator("camera-simulator", **camera | {"flux": photons})
        truth, frame = true_and_shown(study, f"fig9-{name.replace('/', '')}", seen)
        of_aperture: Numbers = {"photons": rounded(photons)}
        shown = {f"{name}: one frame": draw.picture(frame, 3 * photons)}
        for method in METHODS if name in SHOWN else ("SIFT", "direct"):
            run = partial(study.run, "fig9", {**ways[method], "source": seen["source"]})
            folder, of_aperture[method] = scores_or_reason(run, truth)
            error = f"{of_aperture[method]['mean_px']:g} px off" if folder else "not located"
            shown[f"{METHODS[method]}: {error}"] = whole(folder, frame.shape)
        numbers["apertures"][name] = of_aperture
        if name in SHOWN:
            pictures = draw.all_labelled(shown)
            rows += [draw.beside(pictures[:2]), draw.beside(pictures[2:])]
    return draw.in_rows([*rows, high_speed_plot(numbers)]), numbers


def true_and_shown(study: Study, name: str, spec: dict[str, Any]) -> tuple[Path, NDArray[np.float32]]:
    """Write the truth of a camera, and return the name of its capture, which is simulated as it is read, and a frame."""
    capture = study.folder / f"{name}.npy"
    with open_source(parse_spec(spec)) as source:
        assert hasattr(source, "truth")
        np.savez(truth_path(capture), **source.truth())
        middle = source.info.n_frames // 2
        return capture, source.response.flux(source.counts(FrameSpan(middle, middle + 1)).astype(np.float32), 1)


def whole(folder: Path | None, shape: tuple[int, ...]) -> draw.Picture:
    """Return the panorama of a run as high as a frame; a grey field for no run."""
    if folder is None:
        return np.full(shape, 225, np.uint8)
    panorama = draw.picture(load_panorama(folder).flux)
    scaled = draw.fitted(panorama, round(panorama.shape[1] * shape[0] / panorama.shape[0]))
    return cv2.resize(scaled, (scaled.shape[1], shape[0])).astype(np.uint8)


def high_speed_plot(numbers: Numbers) -> draw.Picture:
    """Plot the errors over the light."""
    figure, (panel,) = draw.panels(9.68, 3)
    apertures = numbers["apertures"]
    photons = [case["photons"] for case in apertures.values()]
    for method, colour in {"SIFT": "0.6", "direct": "black"}.items():
        errors = [case[method].get("mean_px", np.nan) for case in apertures.values()]
        panel.loglog(photons, errors, ".-", color=colour, label=METHODS[method])
    draw.ticks(panel, {case["photons"]: f"{name}: {case['photons']:g}" for name, case in apertures.items()})
    draw.name_axes(panel, "photons per pixel per frame", "mean corner error (px)", None)
    panel.legend()
    return draw.drawn(figure)[..., 0]


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
        ),
        Claim(
            "(not in the paper) our default locator at f/5.6",
            f"direct on averages of {numbers['group_size']}: {told(dark['direct'])}",
        ),
    ]


def true_centres(capture: Path) -> NDArray[np.float64]:
    """Return the true positions of a camera that travels: (T, 3) in m."""
    with np.load(truth_path(capture)) as file:
        return positions_of(file["camera_from_world"])


def draw_found(folder: Path, true: NDArray[np.float64], views: dict[Axes, tuple[int, int]], **line: Any) -> None:
    """Draw the positions that a run has found, after the best similarity, on plots of two coordinates each."""
    found = positions_of(np.load(folder / "poses.npz")["camera_from_world"])
    scale, rotation, shift = align_positions(found, true)
    aligned = scale * found @ rotation.T + shift
    for panel, (x, y) in views.items():
        panel.plot(aligned[:, x], aligned[:, y], **line)


def poses(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 11: the path of a camera that travels, from COLMAP on averages of different lengths."""
    spec = study.spec("paper/fig11", {}, QUICK_ROOM)
    capture, numbers = study.capture("fig11", spec), frames_of(spec)
    true = true_centres(capture)
    figure, axes = draw.panels(9.68, 3.4, 1, len(CAMERAS), sharex=True, sharey=True)
    for panel, (name, group) in zip(axes, CAMERAS.items(), strict=True):
        spec["pose"] = {"use": "colmap-averages", "with": {"group_size": group}}
        panel.plot(true[:, 0], true[:, 2], color="black", linewidth=3, alpha=0.25, label="true")
        numbers[name] = {"group_size": group}
        try:
            folder = study.run(f"fig11-{group}", spec, capture)
            score = evaluate_poses(folder, truth_path(capture))
            draw_found(folder, true, {panel: (0, 2)}, color="tab:blue", linewidth=1, label="found")
            numbers[name] |= {
                "ate_percent": rounded(100 * score.ate_share),
                "turns_deg": rounded(score.turns_deg),
                "rotation_deg": rounded(score.rotation_deg),
            }
        except PhotonpanoError as error:
            numbers[name]["reason"] = reason_of(error)
        panel.set_title(f"{name}: {group} frames", fontsize=10)
        draw.name_axes(panel, "x (m)")
    axes[0].set_ylabel("z (m)", fontsize=9)
    axes[0].legend(fontsize=8)
    return draw.in_bgr(figure), numbers


def poses_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 11."""
    cameras = {name: numbers[name] for name in CAMERAS}
    same = "the same: rotations"
    statements = (
        (
            "averages of adjacent binary frames enable better poses than a high-speed or a conventional camera: positions",
            "ate_percent",
            "% of the path",
        ),
        (f"{same}, after the best common rotation of the world", "turns_deg", "degrees"),
        (
            f"{same} in the world that fits the positions best, which errors of the positions turn as a whole",
            "rotation_deg",
            "degrees",
        ),
    )
    claims = []
    for statement, key, unit in statements:
        found = [
            f"{name}, {case['group_size']} frames: " + (case.get("reason") or f"{case[key]:g} {unit}")
            for name, case in cameras.items()
        ]
        values = {name: float(case.get(key, np.inf)) for name, case in cameras.items()}
        claims.append(Claim(statement, "; ".join(found), min(values, key=values.get) == "single-photon, averaged"))
    return claims


def bursts(study: Study) -> tuple[draw.Picture, Numbers]:
    """S1: bursts that are aligned once and stitched, and two levels of ours with groups of the same size."""
    spec = study.spec("paper/s1", {}, QUICK_BURST)
    capture = study.capture("s1", spec)
    burst, burst_db = stitched_exposures(Compared.of(study.run("s1", spec, capture), capture))
    ours_spec: dict[str, Any] = {key: value for key, value in spec.items() if key not in ("merge", "output")}
    ours = Compared.of(study.run("s1-ours", ours_spec | {"levels": [{"scale": 1}] * 2}, capture), capture)
    middles, panorama = ours.middles(), ours.panorama
    height, width = np.min([burst.flux.shape, panorama.flux.shape], axis=0) // 2
    radius, white = (min(110, int(width)), min(80, int(height))), draw.white_of(panorama.flux)
    panoramas = {"bursts in one pass, stitched": burst, "ours, two levels": panorama}
    shown = {name: draw.place(each, middles[len(middles) // 2], radius, white) for name, each in panoramas.items()}
    numbers = {"group_size": group_size(spec), **frames_of(spec), "one_pass_psnr_db": round(burst_db, 1)}
    return draw.beside(draw.all_labelled(shown)), numbers | {"ours": scores_of(ours.folder, capture)}


def stitched_exposures(run: Compared) -> tuple[Panorama, float]:
    """Return the mean of the exposures of a run of one level, each placed where it was located, and its PSNR in dB."""
    exposures = np.load(run.folder / "exposures" / "level-1.npy")
    homographies, _, alignment = first_exposures(run)
    canvas = plan_canvas(FrameTrajectory(homographies), FrameSpan(0, len(homographies)), run.found.frame_shape, 1.0, 2**31)
    total, weight = (np.zeros(canvas.shape, np.float32) for _ in range(2))
    for flux, to_reference in zip(exposures, homographies, strict=True):
        to_canvas, size = canvas.transform @ to_reference, (canvas.width, canvas.height)
        total += cv2.warpPerspective(np.nan_to_num(flux), to_canvas, size)
        weight += cv2.warpPerspective(np.isfinite(flux).astype(np.float32), to_canvas, size)
    seen = weight > 0.5
    panorama = np.where(seen, total / np.maximum(weight, 0.5), np.float32(np.nan))
    scene = run.scene(canvas, alignment)
    return Panorama(panorama, weight, canvas.transform), run.psnr_db(panorama, scene, seen & np.isfinite(scene))


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
