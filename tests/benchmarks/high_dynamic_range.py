"""Measure the flux of a night scene of 120 dB: its error, its bias and its claimed standard deviation, against the bound.

    python tests/benchmarks/high_dynamic_range.py

Simulates 100,000 frames of 72x120 px and renders them four times: of a camera that stands still; of one that trembles by 3 px,
along the true motion; of the latter with dark counts that are corrected; and of the latter without, along the estimated motion.
For each decade of flux it prints the root mean square error and the bias in units of the bound, `sqrt((exp(flux + dark) - 1) /
frames)`, the error in units of the claimed standard deviation, and the share of the pixels whose error is at most two of these.
A panorama interpolates between pixels, so that of a moving camera is compared with the same panorama of frames without noise,
along the true motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from harness import Expected, Study, command, passing, record_of, rendered, seen, simulator, to_reference
from numpy.typing import NDArray

from photonpano import load_trajectory, open_source, parse_spec
from photonpano.evaluation import corner_errors
from photonpano.geometry import Canvas, FrameTrajectory, canvas_of_box, inverse, normalised
from photonpano.merging.canvas_noise import CanvasNoise, DynamicRange
from photonpano_simulator.config import NightScene
from photonpano_simulator.scenes import scene_flux

SHAPE = (72, 120)
SCENE = (240, 320)
LOWEST, HIGHEST = 1e-5, 10.0
"""Range of flux whose decades are listed: 120 dB. The middle 100 dB, of which the photons allow a measurement, are judged."""
JUDGED = (1e-4, 10.0)
LARGEST_ERROR, LEAST_WITHIN = 1.1, 0.95
BRIGHTEST = 10.0
DARK = 0.0013
CAMERAS = (
    ("still", 0.0, 0.0, False),
    ("trembling", 3.0, 0.0, False),
    ("trembling, dark counts", 3.0, DARK, False),
    ("trembling, estimated motion", 3.0, 0.0, True),
)
"""Name, root mean square of the motion in px, dark counts a frame, and whether the motion is estimated."""


@dataclass(frozen=True)
class Measured:
    """Flux with its standard deviation, and what it should be, of all pixels."""

    name: str
    flux: NDArray[np.float64]
    std: NDArray[np.float64]
    true: NDArray[np.float64]
    bound: NDArray[np.float64]
    gathered: DynamicRange


def simulated(n_frames: int, seed: int, rms_px: float, dark: float, folder: Path) -> dict[str, Any]:
    """Return the spec of a simulation whose brightest pixel has the flux `BRIGHTEST`."""
    shape = {"width": SCENE[1], "height": SCENE[0], "seed": seed}
    scene = scene_flux(NightScene(**shape), 1.0)
    camera = {
        "scene": {"kind": "night", **shape},
        "path": {"kind": "hand-shake", "shake": {"rms_px": max(rms_px, 1e-6), "roll_rms_deg": 0.1 if rms_px else 0.0}},
        "flux": BRIGHTEST / float(scene.max()),
        "n_frames": n_frames,
        "frame_shape": list(SHAPE),
        "seed": seed,
        "sensor": {"dark_rate": dark},
    }
    corrections: list[Any] = []
    if dark:
        rates = folder / "dark.npy"
        np.save(rates, np.full(SHAPE, dark, np.float32))
        corrections = [{"dark-counts": {"dark": str(rates)}}]
    return simulator(**camera) | {"corrections": corrections}


def uncorrected(source: Any) -> Any:
    """Return the simulator inside the wrappers of a source."""
    while hasattr(source, "wrapped"):
        source = source.wrapped
    return source


def measured(name: str, n_frames: int, seed: int, rms_px: float, dark: float, study: Study, estimated: bool) -> Measured:
    """Simulate and render one capture, along the true motion or along that of a run."""
    spec = simulated(n_frames, seed, rms_px, dark, study.folder)
    with open_source(parse_spec(spec)) as source:
        bare = uncorrected(source)
        scene, motion = bare.truth()["scene"], bare.truth()["homographies"]

        def view(index: int) -> NDArray[np.float64]:
            """Return the flux of the scene in a frame."""
            return seen(scene, motion[index], SHAPE).astype(np.float64)

        true_motion = found_motion = to_reference(motion)
        std_px = None
        if estimated:
            folder = study.run("run", spec)
            found_run, record = load_trajectory(folder), record_of(folder)
            found_motion, std_px = found_run.homographies, found_run.std_px
            errors = corner_errors(found_motion, motion, SHAPE)
            true_motion = normalised(inverse(errors.alignment) @ motion)
            print(f"\nerror of the estimated motion: {errors.mean_px:.3f} px, at most {errors.max_px:.3f} px")
            expected = (record["motion"] or {}).get("std_px", np.nan)
            print(f"expected by the run: {expected:.3f} px; verdict: {record['verdict']['status']}")
            print(*(f"  {reason['what']}" for reason in record["verdict"]["reasons"]), sep="\n")
        trajectory = FrameTrajectory(found_motion)
        canvas: Canvas = canvas_of_box((12, 12, SHAPE[1] - 12, SHAPE[0] - 12), 1.0)
        noise = CanvasNoise.of(source, trajectory, source.info.span, canvas, std_px)
        panorama = rendered(source, trajectory, canvas)
        if rms_px:
            without_noise = Expected(bare, lambda index: -np.expm1(-view(index)))
            clean = rendered(without_noise, FrameTrajectory(true_motion), canvas)
            # Of frames without noise, half a dark frame more is a bias.
            weight = clean.weight.astype(np.float64)
            lit = -np.expm1(-clean.flux.astype(np.float64)) * (weight + 0.5) / weight
            true = -np.log1p(-np.minimum(lit, 1 - 1e-9))
        else:
            true = view(n_frames // 2)[12:-12, 12:-12]
    gathered = DynamicRange(noise=noise)
    std = np.empty_like(panorama.flux)
    for rows, found in noise.of_tile(panorama.flux, panorama.weight, 0, 0):
        gathered.add(panorama.flux[rows], panorama.weight[rows], found.photons)
        std[rows] = found.whole
    bound = np.sqrt(np.expm1(true + dark) / panorama.weight)
    return Measured(name, panorama.flux.astype(float), std.astype(float), true, bound, gathered)


def table(found: Measured) -> bool:
    """Print the decades of flux; return whether the judged ones hold what is asked."""
    gathered = found.gathered
    print(f"\n{found.name}: {gathered.decibels:.0f} dB of {gathered.measurable_decibels:.0f} dB")
    print("flux             pixels   error / bound   bias / bound   error / std   within 2 std")
    error = found.flux - found.true
    edges = 10.0 ** np.arange(np.log10(LOWEST), np.log10(HIGHEST) + 0.1)
    parts = [(low, high, (found.true >= low) & (found.true < high)) for low, high in pairwise(edges)]
    parts.append((*JUDGED, (found.true >= JUDGED[0]) & (found.true < JUDGED[1])))
    for low, high, part in parts:
        if not part.any():
            continue
        relative = error[part] / found.bound[part]
        rms, within = float(np.sqrt((relative**2).mean())), float((np.abs(error[part]) <= 2 * found.std[part]).mean())
        claimed = float(np.sqrt(((error[part] / found.std[part]) ** 2).mean()))
        figures = f"{rms:15.3f} {relative.mean():+14.3f} {claimed:13.3f} {100 * within:13.1f} %"
        print(f"{low:7.0e} to {high:5.0e} {part.sum():8d} {figures}")
    finite = bool(np.isfinite(found.flux).all() and np.isfinite(found.std).all())
    are = "are finite" if finite else "are NOT finite"
    print(f"saturated: {100 * gathered.saturated_share:.3f} %; flux and standard deviation {are}")
    return finite and rms <= LARGEST_ERROR and within >= LEAST_WITHIN


def main(frames: int = 100_000, seeds: Sequence[int] = (0,)) -> bool:
    """Print a table for each capture, of so many frames over each point."""
    holds = True
    for seed in seeds:
        with passing() as study:
            for name, rms_px, dark, estimated in CAMERAS:
                holds &= table(measured(f"{name}, seed {seed}", frames, seed, rms_px, dark, study, estimated))
    asked = f"error at most {LARGEST_ERROR} of the bound, {100 * LEAST_WITHIN:.0f} % within 2 std"
    print(f"\n{'holds' if holds else 'FAILS'}: {asked}")
    return not holds


if __name__ == "__main__":
    command(main)
