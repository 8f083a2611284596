"""Scenes: a night with each tone, those with depth and a path through one, one finer than the sensor, and a film."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import av
import cv2
import numpy as np
import picture_parts as draw
from harness import RATE_HZ, Compared, Study, packed, simulator
from paper.figures.light import fine_images, fine_pictures
from paper.figures.others import draw_found, true_centres

from photonpano import FloatArray, FrameSpan, load_panorama, open_source, parse_spec
from photonpano.capture.writing import truth_path
from photonpano.photometry import BinaryResponse, Tone, picture_of
from photonpano_poses import evaluate_poses
from photonpano_simulator.config import NightScene
from photonpano_simulator.scenes import scene_flux
from photonpano_simulator.travel import depth, read_truth, sharp_view, truth_of

from . import finished

NIGHT_FLUX = 12.0  # flux of the brightest lamp in the night scene, photons per pixel per frame
NIGHT_FRAMES = 100_000
GROUP_SIZE, FIRST = 30, 300  # frames of an average of the room, and the first frame of the exposures that are shown
ESTIMATORS = {"colmap-averages": "tab:orange", "stratified-pose": "tab:blue"}
"""Pose estimators, with the colours of their lines."""
MAGNIFIED = 1.7
HIGH_SPEED = simulator(
    "camera-simulator",
    path={"kind": "pan", "length_px": 900, "angle_deg": 4, "shake": {"rms_px": 3.0, "frequencies_hz": [3, 5, 8]}},
    flux=1000,
    sensor={"exposure": 0.5},
)
"""A conventional camera pans along the street in 0.4 seconds."""


def pictures(_: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield each picture with its name."""
    yield "night.png", night()
    yield "depth.png", depths()


def night() -> draw.Picture:
    """Show a night scene of 120 dB, as 100,000 frames of a still camera measure it, with each tone."""
    scene = scene_flux(NightScene(width=520, height=346), 1.0)
    scene *= NIGHT_FLUX / scene.max()
    lit = np.random.default_rng(0).binomial(NIGHT_FRAMES, -np.expm1(-scene.astype(float)))
    weight = np.full(scene.shape, NIGHT_FRAMES, np.float32)
    response = BinaryResponse()
    flux = response.debiased(response.flux((lit / NIGHT_FRAMES).astype(np.float32), weight), weight)
    white = float(np.quantile(flux, 0.995))
    tones = get_args(Tone)
    shown = draw.all_labelled({tone: picture_of(flux, white, tone, 0.5 if tone == "local" else 0.0) for tone in tones})
    shown.append(np.full_like(shown[0], 255))
    return np.vstack([draw.beside(shown[first : first + 2]) for first in range(0, len(shown), 2)])


def depths() -> draw.Picture:
    """Show the scenes of `travel-simulator`: a frame without noise, 500 binary frames of it, and its depth."""
    rows = []
    for kind in ("room", "facade", "planes"):
        spec = simulator("travel-simulator", scene={"kind": kind}, path={"kind": "turn-only", "degrees": 0}, n_frames=500)
        with open_source(parse_spec(spec)) as source:
            truth, info = truth_of(source.truth()), source.info
            sharp = sharp_view(truth, 0)
            photons = source.response.flux(source.counts(info.span) / np.float32(info.n_frames), 500)
        white = float(np.quantile(sharp, 0.995))
        near = 1 / depth(truth, 0)
        far, nearest = np.quantile(near, (0.0, 1.0))
        shown = {
            kind: draw.picture(sharp, white),
            "500 frames, 0.3 photons a frame": draw.picture(photons, white),
            f"depth: {1 / nearest:.1f} m (light) to {1 / far:.1f} m (dark)": (40 + 200 * (near - far) / (nearest - far)).astype(
                np.uint8
            ),
        }
        small = {name: cv2.resize(each, (330, 169), interpolation=cv2.INTER_AREA) for name, each in shown.items()}
        rows.append(draw.beside(draw.all_labelled(small)))
    return np.vstack(rows)


def room(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield a frame of a room, an average, the same merged through depth, and the paths; print both scores."""
    spec = study.spec("pipelines/room-capture")
    cube = study.capture("room", spec)
    runs = {}
    for name in ESTIMATORS:
        keys = {"group_size": GROUP_SIZE, "depth": name == "stratified-pose"}
        chosen = {"pose": {"use": name, "with": keys}, "camera": {"focal_px": 160}}
        runs[name] = study.run(name, packed(cube, 1000, **chosen, output={"exposures": True}))
        score = evaluate_poses(runs[name], truth_path(cube))
        print(f"{name:16} ATE {100 * score.ate_share:.3f} % of the path, rotation {score.rotation_deg:.3f} degrees")
    averaged, merged = (
        cv2.imread(str(folder / "images" / f"exposure_{FIRST}.png"), cv2.IMREAD_GRAYSCALE) for folder in runs.values()
    )
    shown = {
        "one frame": np.unpackbits(np.load(cube, mmap_mode="r")[FIRST], axis=-1) * np.uint8(255),
        f"{GROUP_SIZE} frames, averaged": averaged,
        "the same, merged through depth": merged,
    }
    for name, image in shown.items():
        shown[name] = cv2.resize(image, None, fx=MAGNIFIED, fy=MAGNIFIED, interpolation=cv2.INTER_AREA)
    above = draw.beside(draw.all_labelled(shown))
    yield "room.png", draw.in_rows([draw.in_colour(above), paths(runs, cube, above.shape[1])])
    yield "room-depth.png", depth_found(runs["stratified-pose"], cube)


def depth_found(folder: Path, cube: Path) -> draw.Picture:
    """Show an exposure, the inverse depth that was found of it, the true one, and the expected error."""
    exposure, found, std = (
        cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        for name in (f"images/exposure_{FIRST}.png", f"depth/exposure_{FIRST}.tif", f"depth/exposure_{FIRST}_std.tif")
    )
    known, distance = found > 0, np.where(found > 0, found, 1)
    true = 1 / depth(read_truth(truth_path(cube)), FIRST + GROUP_SIZE // 2)
    far, near = np.quantile(true, (0.01, 0.9))
    # A path of the length 1 has another scale.
    scale = float(np.median((true * distance)[known]))
    shown = {
        "30 frames, merged": exposure,
        "inverse depth, found": _levels(np.where(known, scale / distance, 0), far, near),
        "inverse depth, true": _levels(true, far, near),
        "expected error: white is 10 % or more": _levels(np.where(known, std / distance, 0), 0, 0.1),
    }
    for name, image in shown.items():
        shown[name] = cv2.resize(image, None, fx=1.6, fy=1.6, interpolation=cv2.INTER_AREA)
    return draw.beside(draw.all_labelled(shown))


def _levels(values: FloatArray, low: float, high: float) -> draw.Picture:
    return (255 * np.clip((values - low) / (high - low), 0, 1)).astype(np.uint8)


def paths(runs: dict[str, Path], cube: Path, width: int) -> draw.Picture:
    """Return a plot of the true path and of those that were found, from above and from the side, of a width in px."""
    true = true_centres(cube)
    figure, (above, behind) = draw.panels(width / 100, 3.4, 1, 2)
    views = {above: (0, 2), behind: (0, 1)}
    for panel, (x, y) in views.items():
        panel.plot(true[:, x], true[:, y], color="black", linewidth=3, alpha=0.25, label="truth")
        panel.set_aspect("equal", adjustable="datalim")
        draw.name_axes(panel, "x (m)", f"{'xyz'[y]} (m)", None)
    for name, colour in ESTIMATORS.items():
        draw_found(runs[name], true, views, color=colour, linewidth=1.2, label=name)
    behind.invert_yaxis()
    above.set_title("from above", fontsize=10)
    behind.set_title("from behind", fontsize=10)
    above.legend(frameon=False, fontsize=9)
    return draw.in_bgr(figure)


def super_resolution(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield a part of a panorama: interpolated, merged on a fine grid, by super-resolution, and the true scene."""
    cube = study.capture("fine", study.spec("paper/fig7", {"source.with.frame_rate_hz": RATE_HZ}))
    spec = packed(cube, render={"use": "super-resolution", "scale": 2.0})
    of = fine_images(Compared.of(finished(study, "super-resolution", spec, cube), cube))
    named = {"scale 1, interpolated": of["interpolated"], "merge": of["merged"], "super-resolution": of["fine"]}
    yield "super-resolution.png", fine_pictures({**named, "true scene": of["true"]}, (75, 75))


def high_speed(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield a frame of the video of a conventional camera, and the panorama of all."""
    film = filmed(study.folder / "high-speed.mp4")
    spec = {"version": 1, "source": {"use": "video", "with": {"path": str(film.absolute()), "frame_rate_hz": 500}}}
    panorama = load_panorama(finished(study, "high speed", spec, film)).flux
    white = draw.white_of(panorama)
    with open_source(parse_spec(spec)) as source:
        n_frames, middle = source.info.n_frames, source.info.n_frames // 2
        frame = source.response.flux(source.counts(FrameSpan(middle, middle + 1)).astype(np.float32), 1)
    beneath = draw.widened(draw.picture(frame, white), panorama.shape[1])
    shown = {f"one frame of {n_frames}": beneath, f"the {n_frames} frames, as a panorama": draw.picture(panorama, white)}
    yield "high-speed.png", np.vstack(draw.all_labelled(shown))


def filmed(path: Path) -> Path:
    """Write a simulated capture as a video, with its truth, unless it is there."""
    if not path.exists():
        with open_source(parse_spec(HIGH_SPEED)) as source, av.open(str(path), "w") as container:
            stream: Any = container.add_stream("libx264", rate=30)
            stream.height, stream.width, stream.pix_fmt = *source.info.frame_shape, "yuv420p"
            for frame in source.frames(source.info.span):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
            container.mux(stream.encode())
            np.savez(truth_path(path), **source.truth())
    return path
