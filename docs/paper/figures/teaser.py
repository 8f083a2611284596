"""Fig. 1: one frame, the average of a group, its exposure at two levels, and the panorama."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import picture_parts as draw
from harness import Compared, Study, seen
from numpy.typing import NDArray
from paper.figures.study import QUICK_STREET, Claim, Numbers, frames_of, group_size, rounded, scores_of

from photonpano import FrameSpan

QUICK = {
    **QUICK_STREET,
    "source.with.path.length_px": 300,
    "source.with.path.row_spacing_px": 50,
    "source.with.path.centre": None,
    "source.with.flux": 0.3,
    "source.with.n_frames": 3000,
    "resample.with.group_size": 150,
}


def make(study: Study) -> tuple[draw.Picture, Numbers]:
    """Sweep over the street in a fraction of a second."""
    spec = study.spec("paper/fig1", {}, QUICK)
    capture = study.capture("fig1", spec)
    run = Compared.of(study.run("fig1", spec, capture), capture)
    groups = np.load(run.folder / "exposures" / "level-1.npz")["frames"]
    span = FrameSpan(*(int(each) for each in groups[int(0.8 * len(groups))]))
    with run.source() as source:
        frame = source.frames(FrameSpan(span.start, span.start + 1))[0] * np.uint8(255)
    exposures = [exposure_at(run.folder, level, span.centre) for level in (1, 2)]
    flux = run.panorama.flux
    white = draw.white_of(flux)
    numbers: Numbers = {
        **frames_of(spec, "flux"),
        "group_size": group_size(spec),
        "exposure_psnr_db": [round(psnr_db(run, each, at), 1) for at, each in exposures],
        **scores_of(run.folder, capture),
        "pixels": list(flux.shape[:2]),
    }
    numbers["milliseconds"] = rounded(1000 * numbers["n_frames"] / numbers["frame_rate_hz"])
    averaged, merged = (draw.picture(each, white) for _, each in exposures)
    above = {
        f"one frame of {numbers['n_frames']:,}": frame,
        f"{len(span)} frames, averaged (level 1)": averaged,
        "about the same, merged along the motion (level 2)": merged,
    }
    row = draw.beside(draw.all_labelled(above))
    scale = row.shape[1] / flux.shape[1]
    small = cv2.resize(draw.picture(flux, white), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return draw.in_rows([row, draw.labelled(small, "panorama")]), numbers


def exposure_at(run_folder: Path, level: int, instant: float) -> tuple[float, NDArray[np.float32]]:
    """Return the exposure of a level nearest to an instant: its instant and its flux."""
    with np.load(run_folder / "exposures" / f"level-{level}.npz") as file:
        nearest = int(np.abs(file["instants"] - instant).argmin())
        return file["instants"][nearest], np.load(run_folder / "exposures" / f"level-{level}.npy")[nearest]


def psnr_db(run: Compared, flux: NDArray[np.float32], instant: float) -> float:
    """Return the PSNR of an exposure against the view of the true scene at its instant, where the brightest 0.5 % are white."""
    assert run.truth.scene is not None
    view = seen(run.truth.scene, run.truth.homographies[round(instant)], flux.shape)
    white = draw.white_of(view)
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
        ),
        Claim(
            "re-aggregating the photons along the refined motion recovers the scene",
            f"exposures of {numbers['group_size']} frames: {first:.1f} dB at level 1, {second:.1f} dB at level 2",
            second > first,
        ),
        Claim(
            "a panorama from merely half a second",
            f"{numbers['pixels'][0]}x{numbers['pixels'][1]} px from {numbers['milliseconds']:g} ms; corner error "
            f"{numbers['mean_px']:g} px, {numbers['below_oracle_db']:z.1f} dB below the panorama along the true motion",
            numbers["below_oracle_db"] < 1,
        ),
    ]
