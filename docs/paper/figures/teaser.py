"""Fig. 1: one frame, the average of a group, its exposure at two levels, and the panorama."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import tifffile
from paper.figures.study import Claim, FigureOf, frames_of, in_rows, record_of, rounded, scores_of
from picture_parts import beside, labelled, picture

from photonpano import FrameSpan, open_source, parse_spec
from photonpano.captures.writing import truth_path
from photonpano.evaluation import load_truth

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray
    from paper.figures.study import Numbers, Study
    from picture_parts import Picture

QUICK = {
    "source.with.path.length_px": 300,
    "source.with.path.row_spacing_px": 50,
    "source.with.path.centre": None,
    "source.with.flux": 0.3,
    "source.with.n_frames": 3000,
    "source.with.frame_shape": [128, 192],
    "source.with.scene": {"kind": "street", "width": 1024, "height": 682},
    "resample.with.group_size": 150,
}
PANORAMA_PX = 1000
"""Width of the panorama in the picture."""


def make(study: Study) -> tuple[Picture, Numbers]:
    """Sweep over the street in a fraction of a second."""
    spec = study.spec("fig1", {}, QUICK)
    capture = study.capture("fig1", spec)
    run_folder = study.run("fig1", spec, capture)
    group = np.load(run_folder / "exposures" / "level-1.npz")["frames"]
    index = int(0.8 * len(group))
    span = FrameSpan(*(int(each) for each in group[index]))
    with open_source(parse_spec(record_of(run_folder)["spec"])) as source:
        frame = source.frames(FrameSpan(span.start, span.start + 1))[0] * np.uint8(255)
    first, second = (exposure_at(run_folder, level, span.centre) for level in (1, 2))
    flux = tifffile.imread(run_folder / "panorama.tiff")
    white = float(np.nanquantile(flux, 0.995))
    numbers: Numbers = {
        **frames_of(spec),
        "flux": spec["source"]["with"]["flux"],
        "group_size": spec["resample"]["with"]["group_size"],
        "exposure_psnr_db": [round(psnr_db(each, capture, at), 1) for at, each in (first, second)],
        **scores_of(run_folder, capture),
        "pixels": list(flux.shape[:2]),
    }
    numbers["milliseconds"] = rounded(1000 * numbers["n_frames"] / numbers["frame_rate_hz"])
    labels = (
        f"one frame of {numbers['n_frames']:,}",
        f"{len(span)} frames, averaged (level 1)",
        "about the same, merged along the motion (level 2)",
    )
    above = beside(
        [
            labelled(each, label)
            for each, label in zip((frame, picture(first[-1], white), picture(second[-1], white)), labels, strict=True)
        ]
    )
    scale = above.shape[1] / flux.shape[1]
    small = cv2.resize(picture(flux, white), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return in_rows([above, labelled(small, "panorama")]), numbers


def exposure_at(run_folder: Path, level: int, instant: float) -> tuple[float, NDArray[np.float32]]:
    """Return the exposure of a level nearest to an instant: its instant and its flux."""
    with np.load(run_folder / "exposures" / f"level-{level}.npz") as file:
        nearest = int(np.abs(file["instants"] - instant).argmin())
        return file["instants"][nearest], np.load(run_folder / "exposures" / f"level-{level}.npy")[nearest]


def psnr_db(flux: NDArray[np.float32], capture: Path, instant: float) -> float:
    """Return the PSNR of an exposure against the view of the true scene at its instant, where the brightest 0.5 % are white."""
    truth = load_truth(truth_path(capture))
    assert truth.scene is not None
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    view = cv2.warpPerspective(truth.scene, truth.homographies[round(instant)], flux.shape[::-1], flags=flags)
    white = float(np.quantile(view, 0.995))
    known = np.isfinite(flux)
    squared = np.square(np.clip(flux[known] / white, 0, 1) - np.clip(view[known] / white, 0, 1)).mean()
    return float(-10 * np.log10(squared))


def claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 1."""
    first, second = numbers["exposure_psnr_db"]
    return [
        Claim(
            "the prototype captures binary frames at about 100,000 frames per second",
            f"simulated: {numbers['n_frames']:,} frames at {numbers['frame_rate_hz']:,} Hz, {numbers['flux']:g} photons per "
            f"pixel per frame",
            None,
        ),
        Claim(
            "re-aggregating the photons along the refined motion recovers the scene",
            f"exposures of {numbers['group_size']} frames: {first:.1f} dB at level 1, {second:.1f} dB at level 2",
            second > first,
        ),
        Claim(
            "a panorama from merely half a second",
            f"{numbers['pixels'][1]} x {numbers['pixels'][0]} px from {numbers['milliseconds']:g} ms; corner error "
            f"{numbers['mean_px']:g} px, {numbers['below_oracle_db']:.1f} dB below the panorama along the true motion",
            numbers["below_oracle_db"] < 1,
        ),
    ]


FIGURE = FigureOf(make, claims)
