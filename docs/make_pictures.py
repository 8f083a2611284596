"""Make the pictures of the README and of the docs from simulated captures, and from a real one.

    python docs/make_pictures.py

Simulates captures into a folder, `runs/pictures` by default, runs them in several ways, writes the PNG files of docs/images,
and prints the scores that the docs mention. Existing captures and runs are used again.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import av
import cv2
import numpy as np
import tifffile
from interpolation_picture import interpolation
from mandrill_picture import mandrill
from matplotlib.figure import Figure
from picture_parts import GAP, beside, drawn, labelled, picture, stacked
from room_picture import room

from photonpano import (
    FrameSpan,
    Group,
    StageContext,
    evaluate,
    load_spec,
    open_source,
    parse_spec,
    run,
    video,
)
from photonpano.captures.writing import truth_path, write_packed
from photonpano.context import Context
from photonpano.evaluation.images import true_panorama
from photonpano.evaluation.inputs import load_run_trajectory, load_truth
from photonpano.evaluation.trajectory import corner_errors
from photonpano.geometry import Canvas, FrameTrajectory
from photonpano.merging.panorama import plan_canvas, render
from photonpano.photometry import BinaryResponse, Tone, picture_of
from photonpano.report.residual_figures import spectrum_over_noise
from photonpano.residuals.measure import measure
from photonpano.residuals.prediction import Predictions
from photonpano_simulator.config import NightScene
from photonpano_simulator.scenes import scene_flux
from photonpano_simulator.travel.truth import depth, sharp_view, truth_of

if TYPE_CHECKING:
    from picture_parts import Picture

    from photonpano import Plan

IMAGES = Path(__file__).parent / "images"
EXAMPLES = Path(__file__).parents[1] / "examples" / "pipelines"

STREET = {
    "version": 1,
    "source": {
        "use": "simulator",
        "with": {
            "path": {
                "kind": "scan",
                "rows": 2,
                "row_spacing_px": 150,
                "length_px": 1200,
                "centre": [900, 900],
                "shake": {"rms_px": 2.0},
            },
            "flux": 0.1,
            "n_frames": 10000,
        },
    },
}
"""The camera scans the street back and forth in a tenth of a second, with tremor, in low light."""
HIGH_SPEED = {
    "version": 1,
    "source": {
        "use": "camera-simulator",
        "with": {
            "path": {"kind": "pan", "length_px": 900, "angle_deg": 4, "shake": {"rms_px": 3.0, "frequencies_hz": [3, 5, 8]}},
            "flux": 1000,
            "sensor": {"exposure": 0.5},
        },
    },
}
"""A conventional camera pans along the street in 0.4 seconds."""
TREMOR = {
    "version": 1,
    "source": {
        "use": "simulator",
        "with": {
            "scene": {"kind": "street", "width": 1024, "height": 682},
            "path": {
                "kind": "pan",
                "length_px": 100,
                "angle_deg": 10,
                "shake": {"rms_px": 1.0, "frequencies_hz": [223, 590, 1270]},
            },
            "flux": 0.2,
            "n_frames": 6000,
            "frame_shape": [160, 240],
        },
    },
}
"""The camera trembles faster than groups of 180 frames."""
FINE = {
    "version": 1,
    "source": {
        "use": "simulator",
        "with": {
            "scene": {"kind": "street", "width": 2400, "height": 1600},
            "scene_scale": 2,
            "path": {"kind": "loop", "length_px": 160, "centre": [900, 1000], "shake": {"rms_px": 0.6, "roll_rms_deg": 0.02}},
            "flux": 0.2,
            "n_frames": 6000,
            "frame_shape": [128, 160],
        },
    },
}
"""A camera whose pixels average a scene that is twice as fine."""
REFINERS = {"without": ("tab:orange", "[]"), "with": ("tab:blue", "short-spans")}
"""Runs without and with the refiner, with the colours of their lines."""
GROUP_SIZE = 125
LEVELS = ("one level", "two levels", "three levels")
WAYS = ("scan", "constant groups", "naive average")
"""Specs of examples/pipelines, for the capture beside them."""
PLACE = (235, 85)
"""Centre of the compared place, in pixels of the reference frame, which is the same for all specs."""
NIGHT_FLUX = 12.0
"""Flux of the brightest lamp in the night scene, photons per pixel per frame."""
NIGHT_FRAMES = 100_000


def main() -> None:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description="Make the pictures of the docs.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("runs/pictures"), help="for the captures and the runs")
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)

    street = written(parse_spec(STREET), folder / "street.npy")
    for number, name in enumerate(LEVELS, start=1):
        finish(parse_spec(street_spec(street), overrides=[f"levels={number}"], output=in_folder(folder, name)), name, street)
    save("readme.png", readme(folder, street))
    save("levels.png", levels(folder, street))
    save("interpolation.png", interpolation(street))

    capture = written(load_spec(EXAMPLES / "capture.yaml"), folder / "capture.npy")
    for name in WAYS:
        path = EXAMPLES / f"{name.replace(' ', '-')}.yaml"
        overrides = [f"source.with.path={capture.absolute()}"]
        finish(load_spec(path, overrides=overrides, output=in_folder(folder, name)), name, capture)
    save("first-panorama.png", picture(tifffile.imread(in_folder(folder, "scan") / "panorama.tiff"), 0.67))
    save("baselines.png", baselines(folder))
    save("hot-pixels.png", hot_pixels(folder))

    trembling = written(parse_spec(TREMOR), folder / "tremor.npy")
    for name, (_, refiner) in REFINERS.items():
        plan = parse_spec(tremor_spec(trembling), overrides=[f"refine={refiner}"], output=in_folder(folder, f"tremor {name}"))
        finish(plan, f"tremor {name}", trembling)
    save("tremor.png", tremor(folder, trembling))
    save("video.png", video_pictures(in_folder(folder, "tremor with"), folder))

    save("night.png", night())
    save("depth.png", depths())
    save("room.png", room(in_folder(folder, "room")))
    save("mandrill.png", mandrill(in_folder(folder, "mandrill")))

    fine = written(parse_spec(FINE), folder / "fine.npy")
    finish(parse_spec(fine_spec(fine, "super-resolution"), output=in_folder(folder, "fine")), "super-resolution", fine)
    save("super-resolution.png", super_resolution(folder, fine))

    film = filmed(parse_spec(HIGH_SPEED), folder / "high-speed.mp4")
    source = {"use": "video", "with": {"path": str(film.absolute()), "frame_rate_hz": 500}}
    finish(parse_spec({"version": 1, "source": source}, output=in_folder(folder, "high speed")), "high speed", film)
    save("high-speed.png", high_speed(folder, source))


def in_folder(folder: Path, name: str) -> Path:
    """Return the run folder of a run."""
    return folder / name.replace(" ", "-")


def written(plan: Plan, cube: Path) -> Path:
    """Simulate a capture."""
    if not cube.exists():
        with open_source(plan) as source:
            write_packed(source, cube)
    return cube


def filmed(plan: Plan, path: Path) -> Path:
    """Write a simulated capture as a video, with its truth."""
    if not path.exists():
        with open_source(plan) as source, av.open(str(path), "w") as container:
            stream: Any = container.add_stream("libx264", rate=30)
            stream.height, stream.width, stream.pix_fmt = *source.info.frame_shape, "yuv420p"
            for frame in source.frames(source.info.span):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
            container.mux(stream.encode())
            np.savez(truth_path(path), **source.truth())
    return path


def done(plan: Plan) -> Path:
    """Run a plan, unless it was run, and return its run folder."""
    if not (plan.output.directory / "run.json").exists():
        run(plan)
    return plan.output.directory


def finish(plan: Plan, name: str, cube: Path) -> None:
    """Run a plan, and print its scores."""
    scores = evaluate(done(plan), truth_path(cube))
    assert scores.panorama is not None
    print(
        f"{name:16} corner error mean {scores.trajectory.mean_px:.2f} px, worst {scores.trajectory.max_px:.2f} px, "
        f"PSNR {scores.panorama.psnr_db:.2f} dB, {scores.below_oracle_db:.2f} dB below the oracle"
    )


def spec_of(cube: Path, **sections: Any) -> dict[str, Any]:
    """Return the spec of a capture of single photons."""
    source = {"use": "packed-npy", "with": {"path": str(cube.absolute()), "frame_rate_hz": 96_800}}
    return {"version": 1, "source": source, **sections}


def street_spec(cube: Path) -> dict[str, Any]:
    """Return the spec of the street."""
    return spec_of(cube, resample={"use": "midpoint", "with": {"group_size": GROUP_SIZE}})


def readme(folder: Path, cube: Path) -> Picture:
    """Return one frame, the sum of all frames, and the panorama of all frames."""
    with open_source(parse_spec(street_spec(cube))) as source:
        info, response = source.info, source.response
        frame = source.frames(FrameSpan(info.n_frames // 2, info.n_frames // 2 + 1))[0] * np.uint8(255)
        mean = source.counts(info.span).astype(np.float32) / info.n_frames
        average = response.flux(mean, info.n_frames)
    flux = tifffile.imread(in_folder(folder, LEVELS[-1]) / "panorama.tiff")
    white = float(np.nanquantile(flux, 0.995))
    width = 2 * info.width + GAP
    panorama = picture(flux, white)
    panorama = cv2.resize(panorama, (width, round(panorama.shape[0] * width / panorama.shape[1])), interpolation=cv2.INTER_AREA)
    n_frames = f"{info.n_frames:,}"
    return stacked(
        [
            beside(
                [
                    labelled(frame, f"one frame of {n_frames}"),
                    labelled(picture(average, white), f"the {n_frames} frames, averaged"),
                ]
            ),
            labelled(panorama.astype(np.uint8), f"the same {n_frames} frames, as a panorama"),
        ]
    )


def high_speed(folder: Path, section: dict[str, Any]) -> Picture:
    """Return a frame of a video, and its panorama."""
    flux = tifffile.imread(in_folder(folder, "high speed") / "panorama.tiff")
    white = float(np.nanquantile(flux, 0.995))
    with open_source(parse_spec({"version": 1, "source": section})) as source:
        n_frames, middle = source.info.n_frames, source.info.n_frames // 2
        frame = source.response.flux(source.counts(FrameSpan(middle, middle + 1)).astype(np.float32), 1)
    panorama = picture(flux, white)
    beneath = np.full((frame.shape[0], panorama.shape[1]), 255, np.uint8)
    beneath[:, : frame.shape[1]] = picture(frame, white)
    return stacked([labelled(beneath, f"one frame of {n_frames}"), labelled(panorama, f"the {n_frames} frames, as a panorama")])


def levels(folder: Path, cube: Path) -> Picture:
    """Return the exposure of one group at each level, along the motion of the level before."""
    plan = parse_spec(street_spec(cube))
    known = {
        "level 1: no motion is known": None,
        "level 2: along the motion of level 1": in_folder(folder, "one level"),
        "level 3: along the motion of level 2": in_folder(folder, "two levels"),
    }
    with open_source(plan) as source:
        choice = plan.levels[0].merge
        merger = choice.contribution.build(choice.config, StageContext(source.info, source.response))
        start = source.info.n_frames // 5
        group = Group(FrameSpan(start, start + GROUP_SIZE), start + (GROUP_SIZE - 1) / 2)
        pictures = []
        for label, directory in known.items():
            trajectory = None if directory is None else motion(directory)
            flux = merger.merge(source, group, trajectory, 1.0).flux
            pictures.append(labelled(picture(flux[:, 60:380], 0.33), label))
    return beside(pictures)


def baselines(folder: Path) -> Picture:
    """Return the same place of the panoramas of several specs, magnified three times."""
    pictures = []
    for name in WAYS:
        file = f"{name.replace(' ', '-')}.yaml"
        flux = tifffile.imread(in_folder(folder, name) / "panorama.tiff")
        with np.load(in_folder(folder, name) / "trajectory.npz") as trajectory:
            x, y = (trajectory["canvas"] @ (*PLACE, 1))[:2].round().astype(int)
        crop = picture(flux[y - 54 : y + 54, x - 54 : x + 54], 0.67)
        pictures.append(labelled(cv2.resize(crop, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST).astype(np.uint8), file))
    return beside(pictures)


def hot_pixels(folder: Path) -> Picture:
    """Return a place of two panoramas of a sensor with hot pixels, magnified three times: uncorrected and corrected."""
    pictures = []
    for name, corrections in {"hot pixels": "[]", "hot pixels masked": "[hot-pixels]"}.items():
        overrides = [f"corrections={corrections}", "source.with.sensor.hot_rate=[0.5, 2]"]
        plan = load_spec(EXAMPLES / "hot-pixels.yaml", overrides=overrides, output=in_folder(folder, name))
        flux = tifffile.imread(done(plan) / "panorama.tiff")
        y, x = flux.shape[0] // 2, flux.shape[1] // 2
        crop = picture(flux[y - 54 : y + 54, x - 72 : x + 72], 0.67)
        large = cv2.resize(crop, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST).astype(np.uint8)
        pictures.append(labelled(large, f"corrections: {corrections}"))
    return beside(pictures)


def tremor_spec(cube: Path) -> dict[str, Any]:
    """Return a spec whose groups are longer than the periods of the tremor."""
    return spec_of(cube, resample={"with": {"group_size": 180}})


def tremor(folder: Path, cube: Path) -> Picture:
    """Return a plot of the spectra of the shifts of short spans against the panorama."""
    figure = Figure(figsize=(10, 3.2), dpi=100, layout="constrained")
    panel = figure.subplots()
    with open_source(parse_spec(tremor_spec(cube))) as source:
        span, shape = source.info.span, source.info.frame_shape
        for name, (colour, _) in REFINERS.items():
            trajectory = motion(in_folder(folder, f"tremor {name}"))
            canvas = plan_canvas(trajectory, span, shape, 1.0, 2**30)
            panorama = render(source, trajectory, span, canvas, 0.25, Context())
            residuals = measure(span, Predictions.of(source, panorama, canvas, trajectory, shape), Context())
            frequencies, power = spectrum_over_noise(residuals)
            panel.semilogy(96_800 * frequencies, power, color=colour, linewidth=1.2, label=f"{name} the refiner short-spans")
    panel.axhline(1, color="0.5", linewidth=0.8, linestyle="--")
    panel.set_xlim(0, 3000)
    panel.set_xlabel("frequency (Hz)", fontsize=9)
    panel.set_ylabel("power / noise", fontsize=9)
    panel.tick_params(labelsize=8)
    panel.legend(fontsize=8)
    return drawn(figure)[..., 2::-1]


def video_pictures(run_folder: Path, folder: Path) -> Picture:
    """Return three pictures of a video in the plane of the panorama, above three that follow the camera."""
    rows = []
    for view, extent in (("panorama", "panorama"), ("smooth", [12, 12, 228, 148])):
        directory = folder / f"video-{view}"
        if not directory.exists():
            video(run_folder, directory, view=view, exposure=100, trail=view == "panorama", changes=[f"render.extent={extent}"])
        files = sorted(directory.iterdir())
        shown = [cv2.imread(str(files[place]), cv2.IMREAD_GRAYSCALE) for place in (0, len(files) // 2, -1)]
        rows.append(beside(shown))
    width = max(row.shape[1] for row in rows)
    gap = np.full((GAP, width), 255, np.uint8)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1])), constant_values=255) for row in rows]
    return stacked([padded[0], gap, padded[1]])


def fine_spec(cube: Path, renderer: str, scale: float = 2.0) -> dict[str, Any]:
    """Return the spec of the capture whose scene is finer than the sensor."""
    return spec_of(cube, render={"use": renderer, "scale": scale})


def super_resolution(folder: Path, cube: Path) -> Picture:
    """Return a part of the panorama: interpolated, merged on a fine grid, by super-resolution, and the true scene."""
    directory = in_folder(folder, "fine")
    flux, truth = tifffile.imread(directory / "panorama.tiff"), load_truth(truth_path(cube))
    found = load_run_trajectory(directory)
    canvas = Canvas(*flux.shape, found.canvas)
    assert truth.scene is not None
    alignment = corner_errors(found.homographies, truth.homographies, found.frame_shape, found.located).alignment
    scene = true_panorama(truth.scene, canvas, alignment)
    with open_source(parse_spec(fine_spec(cube, "merge"))) as source:
        trajectory, span = FrameTrajectory(found.homographies), source.info.span
        small = plan_canvas(trajectory, span, source.info.frame_shape, 1.0, 2**31)
        coarse, merged = (render(source, trajectory, span, each, 0.125, Context(2)).flux for each in (small, canvas))
    to_small = small.transform @ np.linalg.inv(canvas.transform)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    bicubic = cv2.warpPerspective(np.nan_to_num(coarse), to_small, flux.shape[::-1], flags=flags)
    middle = flux.shape[0] // 2, flux.shape[1] // 2
    part = np.s_[middle[0] - 75 : middle[0] + 75, middle[1] - 75 : middle[1] + 75]
    white = float(np.nanquantile(scene[part], 0.995))
    names = {"scale 1, interpolated": bicubic, "merge": merged, "super-resolution": flux, "true scene": scene}
    shown = {name: np.repeat(np.repeat(picture(image[part], white), 2, 0), 2, 1) for name, image in names.items()}
    return beside([labelled(image, name) for name, image in shown.items()])


def motion(directory: Path) -> FrameTrajectory:
    """Return the estimated motion of a run."""
    with np.load(directory / "trajectory.npz") as trajectory:
        return FrameTrajectory(trajectory["homographies"])


def night() -> Picture:
    """Show a night scene of 120 dB, as 100,000 frames of a still camera measure it, with each tone."""
    scene = scene_flux(NightScene(width=520, height=346), 1.0)
    scene *= NIGHT_FLUX / scene.max()
    lit = np.random.default_rng(0).binomial(NIGHT_FRAMES, -np.expm1(-scene.astype(float)))
    weight = np.full(scene.shape, NIGHT_FRAMES, np.float32)
    response = BinaryResponse()
    flux = response.debiased(response.flux((lit / NIGHT_FRAMES).astype(np.float32), weight), weight)
    white = float(np.quantile(flux, 0.995))
    shown = [labelled(picture_of(flux, white, tone, 0.5 if tone == "local" else 0.0), tone) for tone in get_args(Tone)]
    shown.append(np.full_like(shown[0], 255))
    return stacked([beside(shown[first : first + 2]) for first in range(0, len(shown), 2)])


def depths() -> Picture:
    """Show the scenes of `travel-simulator`: a frame without noise, 500 binary frames of it, and its depth."""
    rows = []
    for kind in ("room", "facade", "planes"):
        camera = {"scene": {"kind": kind}, "path": {"kind": "turn-only", "degrees": 0}, "n_frames": 500}
        with open_source(parse_spec({"version": 1, "source": {"use": "travel-simulator", "with": camera}})) as source:
            truth, info = truth_of(source.truth()), source.info
            sharp, photons = (
                sharp_view(truth, 0),
                source.response.flux(source.counts(info.span) / np.float32(info.n_frames), 500),
            )
        white = float(np.quantile(sharp, 0.995))
        near = 1 / depth(truth, 0)
        far, nearest = np.quantile(near, (0.0, 1.0))
        levels = (40 + 200 * (near - far) / (nearest - far)).astype(np.uint8)
        labels = (kind, "500 frames, 0.3 photons a frame", f"depth: {1 / nearest:.1f} m (light) to {1 / far:.1f} m (dark)")
        shown = (picture(sharp, white), picture(photons, white), levels)
        rows.append(
            beside(
                [
                    labelled(cv2.resize(each, (330, 169), interpolation=cv2.INTER_AREA), label)
                    for each, label in zip(shown, labels, strict=True)
                ]
            )
        )
    return stacked(rows)


def save(name: str, image: Picture) -> None:
    """Write a PNG of 64 grey levels, which halves the file without a visible difference."""
    quantised = np.where(image == 255, 255, image & 0xFC).astype(np.uint8)
    cv2.imwrite(str(IMAGES / name), quantised, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{IMAGES / name}: {(IMAGES / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
