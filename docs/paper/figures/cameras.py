"""Fig. 4: fast and bright, slow and dark, fast and dark: a conventional camera and a single-photon camera on the same path.

And how dark it must be for the conventional camera to fail.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import picture_parts as draw
from harness import Compared, Study, middles
from numpy.typing import NDArray
from paper.figures.study import (
    QUICK_STREET,
    Claim,
    Numbers,
    averaged_in_place,
    frames_of,
    group_size,
    reason_of,
    rounded,
    scores_of,
)

from photonpano import FrameSpan, PhotonpanoError, load_panorama, load_trajectory, open_source, parse_spec
from photonpano.evaluation import corner_errors

CASES = {"fast, bright": (1.0, 1.0), "slow, 6 times darker": (0.25, 1 / 6), "fast, 120 times darker": (1.0, 1 / 120)}
"""Length of the path and light of each column, relative to the first."""
SLOW = CASES["slow, 6 times darker"][0]
DARKER = (1, 6, 24, 60, 120, 240)  # how many times darker than the first column it gets
READ_NOISES = (5, 20)  # standard deviations, in photons
PAPER_DARKER = 6  # how much darker the paper makes it until the conventional camera fails
QUICK_PATH_PX = 200.0
QUICK_FRAMES = 3000
QUICK_GROUP = {"fig4": 200, "fig4-camera": 1}
COLUMN = 420  # width of a column, in px
METHODS = {"stitcher": "OpenCV's Stitcher", "chain": "SIFT from frame to frame"}  # that place conventional frames


def make(study: Study) -> tuple[draw.Picture, Numbers]:
    """Make the three columns."""
    numbers = frames_of(scaled(study, "fig4", 1, 1))
    columns = []
    for name, (length, light) in CASES.items():
        column, numbers[name] = case(study, name, length, light)
        columns.append(draw.in_rows([draw.labelled(column[0], name), *column[1:]]))
    height = max(each.shape[0] for each in columns)
    padded = [np.pad(each, ((0, height - each.shape[0]), (0, draw.GAP), (0, 0)), constant_values=255) for each in columns]
    return np.hstack(padded), numbers


def case(study: Study, name: str, length: float, light: float) -> tuple[list[draw.Picture], Numbers]:
    """Return the pictures of a column, and its numbers."""
    spad, camera = (scaled(study, spec, length, light) for spec in ("fig4", "fig4-camera"))
    label = "fig4-" + name.split(",")[0]
    capture = study.capture(label, spad)
    ours = study.run(label, spad, capture)
    flux = load_panorama(ours).flux
    white = draw.white_of(flux)
    first = study.run(label, spad | {"levels": [{"scale": 1}], "output": {"keep": "exposures"}}, capture)
    naive, naive_db = averaged_in_place(first, capture)

    photons = camera["source"]["with"]["flux"]
    pictures, true_of_camera = shots(camera, white * photons / spad["source"]["with"]["flux"])
    stitched, placed = stitch(pictures)
    chain = in_chain(study, f"{label}-camera", camera, true_of_camera)

    numbers: Numbers = {
        "flux": rounded(spad["source"]["with"]["flux"]),
        "camera_photons": rounded(photons),
        "camera_frames": len(pictures),
        "camera_blur_px": rounded(camera["source"]["with"]["path"]["length_px"] / len(pictures), 2),
        "stitched_frames": placed,
        "chain": chain[1],
        "averages_psnr_db": round(naive_db, 1),
        "ours": scores_of(ours, capture),
    }
    images = {
        f"conventional frame, {len(pictures)} in all": draw.fitted(pictures[len(pictures) // 2], COLUMN),
        f"OpenCV's Stitcher: {placed} of {len(pictures)} frames": stitched,
        f"averages of {group_size(spad)} binary frames": draw.picture(naive.flux, white),
        "ours": draw.picture(flux, white),
    }
    shown = draw.all_labelled({caption: draw.fitted(image, COLUMN) for caption, image in images.items()})
    return [*map(draw.in_colour, shown), paths(Compared.of(ours, capture), chain[0])], numbers


def scaled(study: Study, name: str, length: float, light: float) -> dict[str, Any]:
    """Return a spec of Fig. 4 with another length of the path and another light."""
    spec = study.spec(f"paper/{name}", {}, QUICK_STREET)
    camera = spec["source"]["with"]
    if study.quick:
        camera["n_frames"] = QUICK_FRAMES if name == "fig4" else QUICK_FRAMES // 1000 * 4
        camera["frame_rate_hz"] = 100_000 if name == "fig4" else 400
        camera["path"]["length_px"] = QUICK_PATH_PX
        spec["resample"]["with"]["group_size"] = QUICK_GROUP[name]
    camera["path"] = camera["path"] | {"length_px": camera["path"]["length_px"] * length}
    camera["flux"] = camera["flux"] * light
    return spec


def shots(camera: dict[str, Any], white: float) -> tuple[list[draw.Picture], NDArray[np.float64]]:
    """Return the frames of the conventional camera, up to a white, and their true homographies."""
    with open_source(parse_spec({"version": 1, "source": camera["source"]})) as source:
        assert hasattr(source, "truth")
        counts = [source.counts(FrameSpan(index, index + 1)) for index in range(source.info.n_frames)]
        pictures = [draw.picture(source.response.flux(each.astype(np.float32), 1), white) for each in counts]
        return pictures, source.truth()["homographies"]


def stitch(pictures: list[draw.Picture]) -> tuple[draw.Picture, int]:
    """Return the panorama of OpenCV's Stitcher, and how many of the pictures are in it; a grey field for none.

    Both of its modes are tried, and the one that places more pictures counts.
    """
    for stitcher, placed in placing(pictures, cv2.Stitcher_PANORAMA, cv2.Stitcher_SCANS):
        status, panorama = stitcher.composePanorama()
        if status == cv2.Stitcher_OK:
            grey = cv2.cvtColor(panorama, cv2.COLOR_BGR2GRAY).astype(np.uint8)
            return np.where(panorama.any(axis=2), grey, np.uint8(255)), placed
    return np.full((200, COLUMN), 225, np.uint8), 0


def placing(pictures: list[draw.Picture], *modes: int) -> list[tuple[cv2.Stitcher, int]]:
    """Return the modes of OpenCV's Stitcher that place some pictures, and how many: the one that places most first."""
    found = []
    for mode in modes:
        cv2.setRNGSeed(0)
        stitcher = cv2.Stitcher.create(mode)
        try:
            status = stitcher.estimateTransform([cv2.cvtColor(each, cv2.COLOR_GRAY2BGR) for each in pictures])
        except cv2.error:  # frames with hardly any keypoints
            continue
        if status == cv2.Stitcher_OK:
            found.append((stitcher, len(stitcher.component())))
    return sorted(found, key=lambda each: -each[1])


def in_chain(
    study: Study, name: str, spec: dict[str, Any], true: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, Numbers]:
    """Return the path of the conventional frames, each registered with the one before by SIFT, and its errors."""
    try:
        found = load_trajectory(study.run(name, spec))
    except PhotonpanoError as error:
        return None, {"located": 0, "reason": reason_of(error)}
    located = found.located
    score = corner_errors(found.homographies, true, found.frame_shape, located)
    return middles(score.alignment @ found.homographies, found.frame_shape)[located], {
        "located": int(located.sum()),
        "mean_px": rounded(score.mean_px),
        "worst_px": rounded(score.max_px),
    }


def darker(study: Study) -> tuple[draw.Picture, Numbers]:
    """Count the conventional frames that can be placed while the light of the slow path goes out."""
    times = DARKER[::3] if study.quick else DARKER
    read_noises = READ_NOISES[-1:] if study.quick else READ_NOISES
    cameras = [scaled(study, "fig4-camera", SLOW, 1 / darkness) for darkness in times]
    photons = [rounded(camera["source"]["with"]["flux"]) for camera in cameras]
    numbers: Numbers = {"times_darker": list(times), "photons": photons, "read_noise": {}, **frames_of(cameras[0])}
    figure, axes = draw.panels(9.68, 3, 1, len(read_noises), sharey=True)
    for panel, read_noise in zip(axes, read_noises, strict=True):
        placed: dict[str, list[int]] = {method: [] for method in METHODS}
        for camera in cameras:
            camera["source"]["with"]["sensor"]["read_noise"] = read_noise
            pictures, true = shots(camera, 3 * camera["source"]["with"]["flux"])
            # The mode for flat scenes: in the other, focal lengths are found from noise, and a panorama takes gigabytes.
            placed["stitcher"].append(sum(number for _, number in placing(pictures, cv2.Stitcher_SCANS)))
            placed["chain"].append(in_chain(study, "fig4-darker", camera, true)[1]["located"])
        numbers["read_noise"][str(read_noise)] = placed
        for (method, name), colour in zip(METHODS.items(), ("tab:blue", "tab:red"), strict=True):
            panel.semilogx(photons, placed[method], ".-", color=colour, label=name)
        panel.set_title(f"read noise of {read_noise} photons", fontsize=10)
        draw.ticks(panel, {each: f"{each:g}" for each in photons})
        draw.name_axes(panel, "photons per pixel per frame")
    axes[0].set_ylabel("conventional frames placed", fontsize=9)
    axes[0].legend(fontsize=8)
    return draw.in_bgr(figure), numbers


def darker_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of low light."""
    every, rows = numbers["n_frames"], []
    photons = dict(zip(numbers["times_darker"], numbers["photons"], strict=True))
    for read_noise, counts in numbers["read_noise"].items():
        for method, name in METHODS.items():
            placed = dict(zip(numbers["times_darker"], counts[method], strict=True))
            enough = [times for times, n in placed.items() if n == every]
            short = [times for times, n in placed.items() if n < every]
            rows.append(
                Claim(
                    f"the conventional camera fails in low light: {PAPER_DARKER} times less light than suffices is too little "
                    f"(read noise of {read_noise} photons, {name})",
                    (f"places all {every} frames down to {photons[max(enough)]:g} photons" if enough else "never places all")
                    + ("; " if short else "; never fails")
                    + ", ".join(f"{placed[times]} at {photons[times]:g} photons" for times in short),
                    bool(enough and short) and min(short) <= PAPER_DARKER * max(enough),
                )
            )
    return rows


def paths(ours: Compared, chain: NDArray[np.float64] | None) -> draw.Picture:
    """Return a plot of the true path and of the estimated ones."""
    figure, (panel,) = draw.panels(COLUMN / 100, 2.6)
    panel.plot(*ours.middles(true=True).T, color="black", linewidth=3, alpha=0.3, label="true")
    panel.plot(*ours.aligned_middles().T, color="tab:blue", linewidth=1, label="ours")
    if chain is not None:
        panel.plot(*chain.T, ".-", color="tab:red", linewidth=1, markersize=4, label="conventional, SIFT")
    panel.invert_yaxis()
    draw.name_axes(panel, "x (px)", "y (px)", 8)
    panel.tick_params(labelsize=7)
    panel.legend(fontsize=7)
    return draw.in_bgr(figure)


def claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 4."""
    statements = (
        "fast motion: conventional stitching fails even in sufficient light, because frames are blurred",
        "low light (6 times darker): no matches in the noisy conventional frames",
        "fast and 120 times darker: conventional frames are dominated by read noise",
    )
    rows = []
    for name, statement in zip(CASES, statements, strict=True):
        case = numbers[name]
        chain, ours, every = case["chain"], case["ours"], case["camera_frames"]
        error = f", with a mean error of {chain['mean_px']:g} px" if chain["located"] else ""
        rows += [
            Claim(
                statement,
                f"{every} frames with {case['camera_photons']:g} photons per pixel and a blur of {case['camera_blur_px']:g} px"
                f": OpenCV's Stitcher places {case['stitched_frames']}, SIFT from frame to frame {chain['located']}{error}",
                case["stitched_frames"] < every or chain["located"] < every,
            ),
            Claim(
                f"{name}: near-perfect path and high-fidelity reconstruction from binary frames",
                f"{case['flux']:g} photons per pixel per frame: mean error {ours['mean_px']:g} px, largest "
                f"{ours['worst_px']:g} px; {ours['below_oracle_db']:z.1f} dB below the panorama along the true "
                f"motion (PSNR {ours['psnr_db']:.1f} dB, averages {case['averages_psnr_db']:.1f} dB)",
                ours["below_oracle_db"] < 1,
            ),
        ]
    return rows
