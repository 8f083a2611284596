"""Compare colour with demosaicking, and with a camera of three sensors: the table of docs/how-to/colour.md.

    python tests/benchmarks/colour.py FOLDER PHOTOGRAPH... [--pattern PATTERN.png] [--seeds N] [--flux F] [--frames N] [--large]

For each photograph, filter array and seed, a capture is simulated, and its panorama rendered from the estimated motion. Its
PSNR is compared, over the same pixels, with that of

- groups in which the image moves by less than a pixel, demosaicked by OpenCV's edge-aware method (of a filter array that is no
  Bayer array: each colour interpolated by a Gaussian), and averaged along the estimated motion;
- three sensors before which nothing stands, each of one colour and with as many photons as its coloured pixels get, along the
  true motion.

A large capture has frames of 254x496 px, and a scene and a path that are as much larger. PATTERN.png is a picture of a filter
array with clear pixels, such as that of SwissSPAD2. Writes colour.json and pictures.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile

from photonpano import FrameSpan, evaluate, open_source, parse_spec, run
from photonpano.context import Context
from photonpano.evaluation import corner_errors, covered, image_score, true_panorama, white_flux
from photonpano.geometry import Canvas, FrameTrajectory, inverse, normalised
from photonpano.merging import chunks_of
from photonpano.merging.panorama import render
from photonpano.photometry import BinaryResponse, linear_to_srgb
from photonpano.reading import COLOURS, bayer_array, read_filter_array

GROUP_SIZE, GROUP_PX = 120, 1.0


@dataclass(frozen=True)
class Camera:
    """What is simulated.

    Attributes:
        shape: (height, width) of a frame.
        width: of the scene.
        length_px: of the path.
        n_frames: number of frames.
        flux: mean flux of a clear pixel.
    """

    shape: tuple[int, int] = (128, 192)
    width: int = 700
    length_px: float = 260
    n_frames: int = 3000
    flux: float = 0.5

    def settings(self, seed: int) -> dict[str, Any]:
        """Return keys of the simulator."""
        path = {"kind": "pan", "length_px": self.length_px, "angle_deg": 15, "shake": {"rms_px": 1.0}}
        return {"path": path, "n_frames": self.n_frames, "frame_shape": list(self.shape), "seed": seed}


@dataclass
class Row:
    """Scores of a capture, PSNR in dB."""

    scene: str
    filters: str
    seed: int
    error_px: float
    worst_px: float
    verdict: str
    colour: float
    oracle: float
    demosaicked: float
    three_sensors: float


def measured(photograph: Path, filters: str, seed: int, camera: Camera, folder: Path) -> Row:
    """Simulate one capture, make its panorama and compare it with the others."""
    scene = {"kind": "photo", "file": str(photograph), "width": camera.width}
    simulator = {"scene": scene, "flux": camera.flux, "sensor": {"filters": filters}, **camera.settings(seed)}
    spec: dict[str, Any] = {"version": 1, "source": {"use": "simulator", "with": simulator}}
    places = read_filter_array(Path(filters)) if Path(filters).suffix else bayer_array(filters, camera.shape)
    with open_source(parse_spec(spec)) as source:
        truth, frames = source.truth(), source.frames(FrameSpan(0, camera.n_frames))
    np.save(folder / "cube.npy", np.packbits(frames, axis=-1))
    np.savez(folder / "truth.npz", **truth)
    corrections = [{"colour-filter": {"pattern": filters, "keep": "all"}}]
    packed = {"use": "packed-npy", "with": {"path": str(folder / "cube.npy"), "frame_rate_hz": 96800}}
    run_spec = {"version": 1, "source": packed, "corrections": corrections, "resample": {"with": {"group_size": GROUP_SIZE}}}
    done = run(parse_spec(run_spec, output=folder / "run"), overwrite=True)
    scores = evaluate(done.directory, folder / "truth.npz", oracle=True)

    with np.load(done.directory / "trajectory.npz") as kept:
        homographies, to_canvas, located = kept["homographies"], kept["canvas"], kept["located"]
    flux, weight = (tifffile.imread(done.directory / f"{name}.tiff") for name in ("panorama", "coverage"))
    canvas = Canvas(*flux.shape[:2], to_canvas)
    alignment = corner_errors(homographies, truth["homographies"], camera.shape, located).alignment
    true_image = true_panorama(truth["scene"], canvas, alignment)
    images = {
        "colour": flux,
        "demosaicked": demosaicked(frames, places, FrameTrajectory(homographies), canvas),
        "three_sensors": three_sensors(
            truth, camera.settings(seed), places, normalised(inverse(alignment) @ truth["homographies"]), canvas, folder
        ),
    }
    compared = covered(weight) & np.all([np.isfinite(each).all(axis=-1) for each in images.values()], axis=0)
    white = white_flux(truth["scene"])
    for name, image in {**images, "truth": true_image}.items():
        picture = np.rint(np.nan_to_num(linear_to_srgb(image / white)) * 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{photograph.stem}-{Path(filters).stem}-{name}.png"), picture[..., ::-1])
    psnr = {name: image_score(image, true_image, compared, white).psnr_db for name, image in images.items()}
    errors = scores.trajectory.errors_px[located]
    return Row(
        photograph.stem,
        Path(filters).stem,
        seed,
        float(errors.mean()),
        float(errors.max()),
        done.verdict.status,
        oracle=scores.oracle.psnr_db,
        **psnr,
    )


def demosaicked(frames: np.ndarray, places: np.ndarray, motion: FrameTrajectory, canvas: Canvas) -> np.ndarray:
    """Demosaick groups whose image moves by less than a pixel, and average them along a motion: (H, W, 3) flux."""
    total, seen, shape = np.zeros((*canvas.shape, 3)), np.zeros(canvas.shape), places.shape
    for group in chunks_of(FrameSpan(0, len(frames)), motion, shape, GROUP_PX):
        mean = frames[group.span.start : group.span.stop].mean(axis=0, dtype=np.float32)
        colours = edge_aware(mean) if places.max() < 3 else interpolated(mean, places)
        onto = canvas.transform @ group.homography
        size = canvas.width, canvas.height
        total += len(group.span) * cv2.warpPerspective(colours, onto, size, flags=cv2.INTER_LINEAR)
        seen += len(group.span) * cv2.warpPerspective(np.ones(shape, np.float32), onto, size, flags=cv2.INTER_LINEAR)
    mean = np.divide(total, seen[..., None], out=np.full(total.shape, np.nan), where=seen[..., None] > 1)
    return BinaryResponse().flux(mean.astype(np.float32), len(frames))


def edge_aware(mean: np.ndarray) -> np.ndarray:
    levels = np.rint(65535 * mean).astype(np.uint16)
    return (cv2.cvtColor(levels, cv2.COLOR_BayerRGGB2RGB_EA) / np.float32(65535)).astype(np.float32)


def interpolated(mean: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Interpolate red, green and blue by a Gaussian over the pixels of each."""
    images = []
    for place in range(3):
        mask = (places == place).astype(np.float32)
        lit, near = (cv2.GaussianBlur(each, (0, 0), 2.0) for each in (mean * mask, mask))
        images.append(lit / np.maximum(near, 1e-6))
    return np.stack(images, axis=-1)


def three_sensors(
    truth: dict[str, np.ndarray], camera: dict[str, Any], places: np.ndarray, motion: np.ndarray, canvas: Canvas, folder: Path
) -> np.ndarray:
    """Merge three captures without filters along the true motion, each with the photons of one colour: (H, W, 3) flux."""
    images = []
    for place, name in enumerate(list(COLOURS)[:3]):
        scene, share = truth["scene"][..., place], float((places == place).mean())
        encoded = 65535 * linear_to_srgb(scene / scene.max())
        cv2.imwrite(str(folder / f"{name}.png"), np.rint(encoded).astype(np.uint16))
        given = {"scene": {"kind": "photo", "file": str(folder / f"{name}.png")}, "flux": share * float(scene.mean())}
        spec = {"version": 1, "source": {"use": "simulator", "with": given | camera | {"seed": camera["seed"] + 1000 + place}}}
        # The shake depends on the seed, so that the path comes from a file.
        np.save(folder / "path.npy", truth["homographies"])
        spec["source"]["with"]["path"] = {"kind": "file", "file": str(folder / "path.npy")}
        with open_source(parse_spec(spec | {"corrections": []})) as source:
            span = source.info.span
            images.append(render(source, FrameTrajectory(motion), span, canvas, 0.125, Context(2)).flux / share)
    return np.stack(images, axis=-1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("photographs", type=Path, nargs="+")
    parser.add_argument("--pattern", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--flux", type=float, default=Camera.flux, help="mean flux of a clear pixel")
    parser.add_argument("--frames", type=int, default=Camera.n_frames)
    parser.add_argument("--large", action="store_true", help="frames of 254x496 px")
    given = parser.parse_args()
    size = {"shape": (254, 496), "width": 1808, "length_px": 672} if given.large else {}
    camera = Camera(n_frames=given.frames, flux=given.flux, **size)
    given.folder.mkdir(parents=True, exist_ok=True)
    arrays = ["rggb"]
    if given.pattern is not None:
        pattern = cv2.imread(str(given.pattern))[2 : 2 + camera.shape[0], : camera.shape[1], ::-1]
        np.save(given.folder / "rgbw.npy", pattern)
        arrays.append(str((given.folder / "rgbw.npy").resolve()))
    rows = []
    print("| scene | filters | seed | error (px) | worst | verdict | colour | oracle | demosaicked | three sensors |")
    for photograph in given.photographs:
        for filters in arrays:
            for seed in range(given.seeds):
                row = measured(photograph.resolve(), filters, seed, camera, given.folder.resolve())
                rows.append(asdict(row))
                values = [f"{each:.2f}" if isinstance(each, float) else str(each) for each in asdict(row).values()]
                print("| " + " | ".join(values) + " |", flush=True)
    (given.folder / "colour.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
