"""Score the motion or the panoramas that any program has made of the captures of the open benchmark."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from photonpano.capture import seen_through
from photonpano.contracts.protocols import Trajectory
from photonpano.errors import InputError, PhotonpanoError
from photonpano.evaluation import Evaluation, RunTrajectory, load_panorama, load_truth
from photonpano.evaluation.run_scores import picture_scores
from photonpano.evaluation.run_scores import score as score_of
from photonpano.execution.context import Context, Progress, Quiet, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.geometry import Camera, Canvas, FrameTrajectory, canvas_of
from photonpano.merging.colour import composed
from photonpano.merging.panorama import render
from photonpano.pipeline.components import build_source
from photonpano.reading import reading
from photonpano.record.run_json import read_record
from photonpano.specs import parse_spec
from photonpano.values import FluxImage, FrameSpan, Panorama

from .captures import Benchmark, BenchmarkCapture
from .motion import in_true_plane, read_motion
from .pictures import PICTURES, register_picture

_MOTION = ("", ".npz", ".csv", ".txt")  # a run folder, or a file
_POOR = 0.95  # correlation with the scene, below which a picture hardly fits: that of right ones is 0.96 or more
_LARGEST = 100  # longest side of a panorama that is rendered, in sides of a frame
_SECONDS = "seconds.csv"  # of an entry: a line `capture,seconds` for each
HEADER = ("capture", "error, px", "95 %", "located", "in 3 std", "PSNR, dB", "SSIM", "to oracle", "seconds", "note")
_FORMS = ("{:.3f}", "{:.3f}", "{:.0%}", "{:.0%}", "{:.2f}", "{:.3f}", "{:.2f}", "{:.1f}")

Pictures: TypeAlias = "tuple[FluxImage, FluxImage]"  # flux and weight
Along: TypeAlias = "Callable[..., Panorama]"


@dataclass(frozen=True, slots=True)
class CaptureScore:
    """The score of an entry on one capture; None where the entry, or the truth, does not tell."""

    capture: str  # its name
    error_px: float | None = None  # mean corner error of the located frames, after the best alignment
    p95_px: float | None = None  # their 95 % quantile
    located_share: float | None = None  # of the frames
    honest_share: float | None = None  # of the located frames, those off by at most three times the error that the entry states
    psnr_db: float | None = None  # of the panorama against the true scene
    ssim: float | None = None  # likewise
    below_oracle_db: float | None = None  # how much the panorama along the true motion is better
    seconds: float | None = None  # that the program took, as the entry says
    note: str = ""  # what was adapted, or why there is no score

    def cells(self) -> list[str]:
        """Return the row of the table."""
        values = list(asdict(self).values())[1:-1]
        shown = ("-" if value is None else form.format(value) for value, form in zip(values, _FORMS, strict=True))
        return [self.capture, *shown, self.note]


def score(
    folder: Path | str,
    entry: Path | str,
    truths: Path | str | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[CaptureScore, ...]:
    """Score an entry of the benchmark, from any program.

    An entry is a folder. For a capture such as flat it has a run folder flat/, or the motion as flat.npz, flat.csv or flat.txt
    (TUM), or only a panorama as flat.png or flat.tiff. Of a motion alone, the panorama is rendered. seconds.csv may have the
    time of each, as lines such as flat,12.5.

    Args:
        folder: of the captures.
        entry: the folder of the entry.
        truths: the folder of the truth of the sealed captures, for those who have it.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.

    Raises:
        InputError: the folder is no benchmark, or of another version; or the entry is empty.
    """
    folder, entry = Path(folder), Path(entry)
    benchmark = Benchmark.read(folder)
    if not entry.is_dir():
        raise InputError(f"{entry} is not a folder; give one with a file or a run folder for each capture")
    found = {name: path for name in benchmark.captures if (path := _found(entry, name)) is not None}
    if not found:
        raise InputError(
            f"{entry} has nothing for any of the captures: name files or run folders after them, such as "
            f"{next(iter(benchmark.captures))}.csv; there are {', '.join(benchmark.captures)}"
        )
    seconds = _seconds(entry / _SECONDS, benchmark)
    scores = []
    with one_thread_inside(), usual(progress).stage("scoring", len(found), "captures") as advance:
        for name, capture in benchmark.captures.items():
            truth = next(
                (path for each in (folder, truths) if each and (path := Path(each, f"{name}.truth.npz")).exists()), None
            )
            if name not in found:
                scores.append(CaptureScore(name, note="no entry"))
            elif truth is None:
                scores.append(CaptureScore(name, note="its truth is sealed: send the entry"))
            else:
                scores.append(_scored(name, capture, folder, found[name], truth, seconds.get(name)))
            advance(name in found)
    return tuple(scores)


def _found(entry: Path, name: str) -> Path | None:
    """Return what an entry has for a capture, the motion before a panorama; None if it has nothing."""
    paths = (entry / f"{name}{suffix}" for suffix in (*_MOTION, *PICTURES))
    return next((path for path in paths if path.exists()), None)


def _scored(
    name: str, capture: BenchmarkCapture, folder: Path, path: Path, truth_path: Path, seconds: float | None
) -> CaptureScore:
    try:
        truth = load_truth(truth_path)
        lens = None if truth.turn is None else truth.turn.camera
        along, through_lens = partial(_rendered, capture, folder, None), partial(_rendered, capture, folder, lens)
        if path.suffix in PICTURES:
            picture = register_picture(path, truth)
            # The picture is aligned with the scene, to whose plane the true motion maps.
            scored, oracle, _ = picture_scores(
                picture.flux,
                picture.weight,
                truth,
                canvas=picture.canvas,
                alignment=picture.alignment,
                true_homographies=truth.ideal_homographies,
                render=through_lens,
                origin=path,
            )
            note = "a panorama only, registered with the scene" + ", mirrored" * picture.mirrored
            if picture.correlation < _POOR:
                note += f"; it fits poorly (correlation {picture.correlation:.2f}), as one that is not on a plane does"
            below = None if oracle is None else oracle.psnr_db - scored.psnr_db
            return CaptureScore(
                name, psnr_db=scored.psnr_db, ssim=scored.ssim, below_oracle_db=below, seconds=seconds, note=note
            )
        motion, notes = read_motion(path, capture)
        if path.is_dir():
            panorama: Callable[[], Pictures] | None = partial(load_panorama, path)
            if seconds is None:
                seconds = read_record(path)["seconds"]
        else:
            motion, adapted = in_true_plane(motion, truth)
            motion, panorama = _panorama(motion, along)
            notes += adapted
        found = score_of(motion, truth, panorama, along if motion.camera is None else through_lens, path)
    except PhotonpanoError as error:
        return CaptureScore(name, seconds=seconds, note=str(error))
    return _of(name, found, motion, seconds, "; ".join(notes))


def _of(name: str, found: Evaluation, motion: RunTrajectory, seconds: float | None, note: str) -> CaptureScore:
    states = np.isfinite(motion.std_px[motion.located]).any()
    image = found.panorama
    return CaptureScore(
        name,
        found.trajectory.mean_px,
        found.trajectory.p95_px,
        found.trajectory.located_share,
        found.honest_share if states else None,
        None if image is None else image.psnr_db,
        None if image is None else image.ssim,
        found.below_oracle_db,
        seconds,
        note,
    )


def _panorama(motion: RunTrajectory, along: Along) -> tuple[RunTrajectory, Callable[[], Pictures] | None]:
    """Return how to render the panorama of a motion; None if no plane holds it."""
    frames = np.flatnonzero(motion.located)
    shown = motion.homographies[frames[0] : frames[-1] + 1]
    try:
        canvas = canvas_of(shown, motion.frame_shape, 1.0)
    except ValueError:  # the camera turns too far for a plane
        return motion, None
    if max(canvas.shape) > _LARGEST * max(motion.frame_shape):
        return motion, None

    def rendered() -> Pictures:
        panorama = along(FrameTrajectory(motion.homographies), canvas, FrameSpan(int(frames[0]), int(frames[-1]) + 1))
        return panorama.flux, panorama.weight

    return replace(motion, canvas=canvas.transform), rendered


def _rendered(
    capture: BenchmarkCapture,
    folder: Path,
    lens: Camera | None,
    trajectory: Trajectory,
    canvas: Canvas,
    span: FrameSpan | None = None,
) -> Panorama:
    """Merge the frames of a capture along a motion; all frames by default. Through a lens, motion is that of ideal pixels."""
    path = str(folder / capture.file)
    spec: dict[str, Any] = {"version": 1, "source": {"use": "packed-npy", "with": {"path": path}}}
    if capture.filters is not None:
        spec["corrections"] = [{"colour-filter": {"pattern": capture.filters, "keep": "all"}}]
    plan = parse_spec(spec)
    with build_source(plan) as opened:
        source = opened if lens is None else seen_through(opened, lens)
        context = Context(threads=thread_count(plan.run.threads), progress=Quiet())
        images = render(source, trajectory, span or source.info.span, canvas, plan.render.tolerance_px, context)
        return composed(images, source)


def _seconds(path: Path, benchmark: Benchmark) -> dict[str, float]:
    """Read how long the program took for each capture; nothing if the entry does not say it."""
    if not path.exists():
        return {}
    with reading(path, "is no table of lines such as flat,12.5"), path.open(newline="", encoding="utf-8") as file:
        table = {name: float(seconds) for name, seconds in csv.reader(file)}
    if unknown := sorted(set(table) - set(benchmark.captures)):
        raise InputError(f"{path}: there is no capture {' or '.join(unknown)}")
    return table
