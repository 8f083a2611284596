"""Compare colour with demosaicking, and with a camera of three sensors: the tables of docs/how-to/colour.md and limits.md.

    python tests/benchmarks/colour.py FOLDER PHOTOGRAPH... [--pattern PATTERN.png] [--seeds N] [--flux F] [--frames N] [--large]
    python tests/benchmarks/colour.py FOLDER PHOTOGRAPH... --limits [--flux F ...] [--frames N]

For each photograph, filter array and seed, a capture is simulated, and its panorama rendered from the estimated motion. Its
PSNR is compared, over the same pixels, with that of

- groups in which the image moves by less than a pixel, demosaicked by OpenCV's edge-aware method (of a filter array that is no
  Bayer array: each colour interpolated by a Gaussian), and averaged along the estimated motion;
- three sensors before which nothing stands, each of one colour and with as many photons as its coloured pixels get, along the
  true motion.

A large capture has frames of 254x496 px, and a scene and a path that are as much larger. PATTERN.png is a picture of a filter
array with clear pixels, such as that of SwissSPAD2. Writes pictures into the folder.

`--limits` tells noise from blur, behind a Bayer array and along the true motion, with and without photon noise: of each colour
merged alone, of photonpano, which shares the detail of all colours, of demosaicked groups, and of three sensors with the
photons of each colour, also with shared detail. It prints the PSNR in dB of each, that of the image without noise, that of its
noise alone, and the best that the image reaches when it is smoothed by a Gaussian, with the width of that: a comparison in
which no method gains by blur.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import (
    Compared,
    Expected,
    Study,
    command,
    groups,
    packed,
    record_of,
    rendered,
    scores_of,
    seen,
    simulator,
    table,
    to_reference,
)
from numpy.typing import NDArray

from photonpano import FrameSpan, open_source, parse_spec
from photonpano.capture.writing import truth_path
from photonpano.corrections.colour_filter import with_colours
from photonpano.evaluation import covered, image_score, true_panorama, white_flux
from photonpano.geometry import Canvas, FrameTrajectory, canvas_of, inverse, normalised
from photonpano.merging import chunks_of
from photonpano.merging.colour import composed, filled, with_shared_detail
from photonpano.photometry import BinaryResponse, linear_to_srgb
from photonpano.reading import COLOURS, bayer_array, read_filter_array
from photonpano.testing import MemorySource

GROUP_SIZE, GROUP_PX = 120, 1.0
FLUXES = (0.5, 0.1, 0.02)  # without --limits, the first
SHARE = np.array([0.25, 0.5, 0.25], np.float32)  # of the pixels of a Bayer array that are red, green and blue
BLURS_PX = (0.0, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5, 2.0)


@dataclass(frozen=True)
class Camera:
    """What is simulated: (height, width) of a frame, widths of scene and path in px, frames, and flux of a clear pixel."""

    flux: float = FLUXES[0]
    n_frames: int = 3000
    shape: tuple[int, int] = (128, 192)
    width: int = 700
    length_px: float = 260

    def along_path(self, seed: int) -> dict[str, Any]:
        """Return the keys of the simulator that do not tell of light."""
        path = {"kind": "pan", "length_px": self.length_px, "angle_deg": 15, "shake": {"rms_px": 1.0}}
        return {"path": path, "n_frames": self.n_frames, "frame_shape": list(self.shape), "seed": seed}

    def spec(self, photograph: Path, filters: str, seed: int) -> dict[str, Any]:
        """Return the spec that simulates a capture."""
        scene = {"kind": "photo", "file": str(photograph), "width": self.width}
        return simulator(scene=scene, flux=self.flux, sensor={"filters": filters}, **self.along_path(seed))


def measured(photograph: Path, filters: str, seed: int, camera: Camera, study: Study) -> Iterator[str]:
    """Simulate one capture, make its panorama and compare it with the others: yield the cells of a row."""
    places = read_filter_array(Path(filters)) if Path(filters).suffix else bayer_array(filters, camera.shape)
    with open_source(parse_spec(camera.spec(photograph, filters, seed))) as source:
        truth, frames = source.truth(), source.frames(FrameSpan(0, camera.n_frames))
    name = f"{photograph.stem}-{Path(filters).stem}-{seed}-{camera.flux:g}-{camera.n_frames}"
    cube = study.folder / f"{name}.npy"
    np.save(cube, np.packbits(frames, axis=-1))
    np.savez(truth_path(cube), **truth)
    corrections = [{"colour-filter": {"pattern": filters, "keep": "all"}}]
    folder = study.run(name, packed(cube, corrections=corrections, resample={"with": groups(GROUP_SIZE)["with"]}))
    run, scores = Compared.of(folder, cube), scores_of(folder, cube)
    assert scores.oracle is not None
    canvas, panorama, true_image = run.canvas, run.panorama, run.scene(run.canvas)
    true_motion = normalised(inverse(run.score.alignment) @ truth["homographies"])
    images = {
        "colour": panorama.flux,
        "demosaicked": demosaicked(frames, places, run.motion, canvas),
        "three_sensors": three_sensors(truth, camera.along_path(seed), places, true_motion, canvas, study.folder),
    }
    compared = covered(panorama.weight) & np.all([np.isfinite(each).all(axis=-1) for each in images.values()], axis=0)
    for of, image in {**images, "truth": true_image}.items():
        picture = np.rint(np.nan_to_num(linear_to_srgb(image / white_flux(truth["scene"]))) * 255).astype(np.uint8)
        cv2.imwrite(str(study.folder / f"{photograph.stem}-{Path(filters).stem}-{of}.png"), picture[..., ::-1])
    psnr = {of: run.psnr_db(image, true_image, compared) for of, image in images.items()}
    verdict = record_of(folder)["verdict"]["status"]
    figures = (psnr["colour"], scores.oracle.psnr_db, psnr["demosaicked"], psnr["three_sensors"])
    yield from (photograph.stem, Path(filters).stem, str(seed), f"{run.score.mean_px:.2f}", f"{run.score.max_px:.2f}", verdict)
    yield from (f"{each:.2f}" for each in figures)


def demosaicked(frames: np.ndarray, places: np.ndarray, motion: FrameTrajectory, canvas: Canvas) -> np.ndarray:
    """Demosaick groups whose image moves by less than a pixel, and average them along a motion: (H, W, 3) flux."""
    total, covering, shape = np.zeros((*canvas.shape, 3)), np.zeros(canvas.shape), places.shape
    for group in chunks_of(FrameSpan(0, len(frames)), motion, shape, GROUP_PX):
        mean = frames[group.span.start : group.span.stop].mean(axis=0, dtype=np.float32)
        colours = edge_aware(mean) if places.max() < 3 else interpolated(mean, places)
        onto = canvas.transform @ group.homography
        size = canvas.width, canvas.height
        total += len(group.span) * cv2.warpPerspective(colours, onto, size, flags=cv2.INTER_LINEAR)
        covering += len(group.span) * cv2.warpPerspective(np.ones(shape, np.float32), onto, size, flags=cv2.INTER_LINEAR)
    mean = np.divide(total, covering[..., None], out=np.full(total.shape, np.nan), where=covering[..., None] > 1)
    return BinaryResponse().flux(mean.astype(np.float32), len(frames))


def edge_aware(mean: np.ndarray) -> np.ndarray:
    """Interpolate red, green and blue behind a Bayer array."""
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
    # The shake depends on the seed, so that the path comes from a file.
    np.save(folder / "path.npy", truth["homographies"])
    for place, name in enumerate(list(COLOURS)[:3]):
        scene, share = truth["scene"][..., place], float((places == place).mean())
        encoded = 65535 * linear_to_srgb(scene / scene.max())
        cv2.imwrite(str(folder / f"{name}.png"), np.rint(encoded).astype(np.uint16))
        keys = camera | {"seed": camera["seed"] + 1000 + place, "path": {"kind": "file", "file": str(folder / "path.npy")}}
        capture = simulator(
            scene={"kind": "photo", "file": str(folder / f"{name}.png")}, flux=share * float(scene.mean()), **keys
        )
        with open_source(parse_spec(capture | {"corrections": []})) as source:
            images.append(rendered(source, FrameTrajectory(motion), canvas).flux / share)
    return np.stack(images, axis=-1)


def chances_of(scene: np.ndarray, motion: np.ndarray, places: np.ndarray) -> list[np.ndarray]:
    """Return the probability that each pixel is lit behind the array, and on each of three sensors: (T, H, W) each."""
    chances = [np.empty((len(motion), *places.shape), np.float32) for _ in range(4)]
    for index, homography in enumerate(motion):
        view = seen(scene, homography, places.shape)
        lights = [np.take_along_axis(view, places[..., None].astype(int), axis=-1)[..., 0], *np.moveaxis(SHARE * view, -1, 0)]
        for chance, light in zip(chances, lights, strict=True):
            chance[index] = -np.expm1(-light)
    return chances


def images_of(cubes: list[Any], sources: list[Any], places: np.ndarray, motion: FrameTrajectory, canvas: Canvas) -> Any:
    """Return the images by name, and the number of frames that saw each pixel in each colour."""
    bayer = with_colours(sources[0], places.astype(np.int8))
    raw = rendered(bayer, motion, canvas)
    three = np.stack([rendered(each, motion, canvas).flux for each in sources[1:]], axis=-1) / SHARE
    frames = raw.weight.sum(axis=-1, keepdims=True) * SHARE
    images = {
        "merged": filled(raw.flux, raw.weight),
        "photonpano": composed(raw, bayer).flux,
        "demosaicked": demosaicked(cubes[0], places, motion, canvas),
        "three sensors": three,
        "three sensors, shared": with_shared_detail(np.nan_to_num(three), frames, BinaryResponse()),
    }
    return images, raw.weight


def noise_and_blur(photograph: Path, camera: Camera, seed: int) -> Iterator[Sequence[str]]:
    """Yield the rows of one capture: of each image, what noise and what blur takes from it."""
    with open_source(parse_spec(camera.spec(photograph, "rggb", seed))) as source:
        truth: Any = source.truth()
    places, rng = bayer_array("rggb", camera.shape), np.random.default_rng(seed + 1)
    relative = to_reference(truth["homographies"])
    canvas, motion = canvas_of(relative, camera.shape, 1.0), FrameTrajectory(relative)
    chances = chances_of(truth["scene"], truth["homographies"], places)
    lit = [(rng.random(each.shape, np.float32) < each).astype(np.uint8) for each in chances]
    with_noise = [MemorySource(each) for each in lit]
    noisy, weight = images_of(lit, with_noise, places, motion, canvas)
    without = [Expected(source, each.__getitem__) for source, each in zip(with_noise, chances, strict=True)]
    clean, _ = images_of(chances, without, places, motion, canvas)
    expected = true_panorama(truth["scene"], canvas, truth["homographies"][camera.n_frames // 2])
    compared = covered(weight) & np.all([np.isfinite(each).all(axis=-1) for each in noisy.values()], axis=0)
    white = white_flux(truth["scene"])

    def score(image: NDArray[np.float32], blur_px: float = 0.0) -> float:
        smooth = cv2.GaussianBlur(np.nan_to_num(image), (0, 0), blur_px) if blur_px else image
        return image_score(smooth, expected, compared, white).psnr_db

    for name, image in noisy.items():
        difference = linear_to_srgb(image[compared] / white) - linear_to_srgb(clean[name][compared] / white)
        noise_db = -10 * np.log10(np.square(difference, dtype=np.float64).mean())
        best_db, blur_px = max((score(image, blur_px), blur_px) for blur_px in BLURS_PX)
        values = [f"{each:.1f}" for each in (score(image), score(clean[name]), noise_db, best_db, blur_px)]
        yield photograph.stem, f"{camera.flux:g}", f"{weight[compared].sum(axis=-1).mean():.0f}", name, *values


def main(
    folder: Path,
    *photographs: Path,
    pattern: Path | None = None,
    seeds: int = 1,
    flux: Sequence[float] = FLUXES,
    frames: int = Camera.n_frames,
    large: bool = False,
    limits: bool = False,
) -> None:
    """Print a table for each photograph, and flux or filter array and seed."""
    photographs = tuple(each.resolve() for each in photographs)
    if limits:
        cases = [(each, Camera(light, frames)) for each in photographs for light in flux]
        head = ("scene", "flux", "frames", "image", "PSNR", "without noise", "noise alone", "smoothed", "by (px)")
        table(head, (row for photograph, camera in cases for row in noise_and_blur(photograph, camera, 0)))
        return
    size: dict[str, Any] = {"shape": (254, 496), "width": 1808, "length_px": 672} if large else {}
    camera, study = Camera(flux[0], frames, **size), Study(folder.resolve())
    study.folder.mkdir(parents=True, exist_ok=True)
    arrays = ["rggb"]
    if pattern is not None:
        array = cv2.imread(str(pattern))[2 : 2 + camera.shape[0], : camera.shape[1], ::-1]
        np.save(study.folder / "rgbw.npy", array)
        arrays.append(str(study.folder / "rgbw.npy"))
    cases = [(each, filters, seed) for each in photographs for filters in arrays for seed in range(seeds)]
    head = ("scene", "filters", "seed", "error (px)", "worst", "verdict", "colour", "oracle", "demosaicked", "three sensors")
    table(head, (measured(*case, camera, study) for case in cases))


if __name__ == "__main__":
    command(main)
