"""Lay runs of one capture side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from photonpano.api.command import command
from photonpano.capture.writing import truth_path
from photonpano.errors import InputError, OutputError
from photonpano.evaluation import evaluate, load_run_trajectory
from photonpano.evaluation.inputs import RunTrajectory
from photonpano.evaluation.run_scores import motion_difference, on_canvas, reduced
from photonpano.files.atomic import atomic_path
from photonpano.files.folders import require_new
from photonpano.record.contents import require_one_run
from photonpano.record.run_json import read_record
from photonpano.record.schema import PanoramaRecord, RunRecord
from photonpano.report import ComparedRun, render_comparison
from photonpano.text import columns

_PICTURE_PIXELS = 1600  # longer side of a panorama on the page
_FILES = ("trajectory.npz", "panorama.png")


@dataclass(frozen=True, slots=True)
class Comparison:
    """Runs of one capture, laid side by side.

    Attributes:
        page: the page.
        runs: names of the runs, as the page has them.
        mean_difference_px: for each run, how far the corners of its frames are on average from where the first run has them, in
            px of a frame, after the best alignment of the planes; 0 for the same motion, and None for the first run.
    """

    page: Path
    runs: tuple[str, ...]
    mean_difference_px: tuple[float | None, ...]


def _lines(found: Comparison) -> Iterator[str]:
    _, *means = found.mean_difference_px
    differences = [f"{mean:.3g} px from it on average" if mean else "the same motion" for mean in means]
    yield columns([*zip(found.runs, ["the motion to compare with", *differences], strict=True)])
    yield f"page  {found.page.resolve()}"


@command(
    "runs/first runs/second --output compare.html",
    _lines,
    runs=typer.Argument(metavar="RUN RUN..."),
    output=typer.Option("--output", "-o", metavar="PAGE.html"),
    truth=typer.Option(metavar="TRUTH.npz"),
)
def compare(
    runs: Sequence[Path | str],
    output: Path | str = "compare.html",
    truth: Path | str | None = None,
    *,
    overwrite: bool = False,
) -> Comparison:
    """Lay runs of one capture side by side, on a page of its own: motion, panoramas, scores, and settings that differ.

    Captures are not opened. The first run is the one that the others are compared with.

    Args:
        runs: at least two run folders.
        output: the page, whose name ends in .html.
        truth: the `.truth.npz` of a simulated capture, for scores; by default the one beside the capture, if it is there.
        overwrite: replace the page that is there under this name.

    Raises:
        InputError: a folder is no run with a panorama, the runs are of different captures, or two of them located no frame in
            common; or the truth is that of another capture.
        OutputError: the page is there already, or cannot be written; or its name has another ending.
    """
    folders, page = [Path(run) for run in runs], Path(output)
    if page.suffix != ".html":
        raise OutputError(f"cannot write {output}: the page is HTML; choose a name that ends in .html")
    if len({folder.absolute().resolve() for folder in folders}) < max(2, len(folders)):
        raise InputError("a comparison needs at least two different run folders")
    require_new(page, overwrite)
    runs_read = [_read(folder) for folder in folders]
    for other in runs_read[1:]:
        _require_same_capture(runs_read[0], other)
    parts = [folder.absolute().resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts)) + 1):  # the shortest path suffixes that differ from each other
        names = ["/".join(each[-length:]) for each in parts]
        if len(set(names)) == len(names):
            break
    compared = _compared(runs_read, names, _truth(truth, runs_read[0]))
    with atomic_path(page) as temporary:
        temporary.write_text(render_comparison(compared, page), encoding="utf-8")
    return Comparison(page, tuple(names), tuple(run.mean_difference_px for run in compared))


@dataclass(frozen=True, slots=True)
class _Run:
    """What is read of a run folder."""

    folder: Path
    record: RunRecord
    motion: RunTrajectory

    @property
    def files(self) -> list[Path]:
        return [Path(file["path"]) for file in (self.record.get("capture") or {}).get("files") or ()]


def _read(folder: Path) -> _Run:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; give the run folders that `photonpano run` wrote")
    require_one_run(folder, list(_FILES))
    return _Run(folder, read_record(folder), load_run_trajectory(folder))


def _require_same_capture(first: _Run, other: _Run) -> None:
    """Refuse runs whose frames are not the same."""
    one, another = ((run.record.get("capture") or {}).get("frames_sha256") for run in (first, other))
    if len(first.motion.homographies) != len(other.motion.homographies) or (one != another and None not in (one, another)):
        names = [run.files[0].name if run.files else "a capture without a file" for run in (first, other)]
        described = [
            f"{run.folder} is a run of {name} ({run.record['source']['n_frames']:,} frames)"
            for run, name in zip((first, other), names, strict=True)
        ]
        raise InputError(f"{' and '.join(described)}: these are different captures; compare runs of one capture")
    if first.motion.frame_shape != other.motion.frame_shape:
        described = ["{} has frames of {}x{}".format(run.folder, *run.motion.frame_shape) for run in (first, other)]
        raise InputError(f"{' and '.join(described)}, after other corrections; compare runs with the same frames")


def _truth(given: Path | str | None, run: _Run) -> Path | None:
    """Return the truth that was given, or that lies beside the capture."""
    if given is not None:
        return Path(given)
    return next((beside for file in run.files[:1] if (beside := truth_path(file)).is_file()), None)


def _compared(runs: Sequence[_Run], names: Sequence[str], truth: Path | None) -> list[ComparedRun]:
    """Align each run with the first, and score it."""
    panoramas = [_panorama(run) for run in runs]
    shapes = [(panorama["height"], panorama["width"]) for panorama in panoramas]
    canvases = [run.motion.canvas_of(shape) for run, shape in zip(runs, shapes, strict=True)]
    common = reduced(canvases[0], _PICTURE_PIXELS)
    in_srgb = all(((run.record["spec"].get("render") or {}).get("tone") or "srgb") == "srgb" for run in runs)
    found = []
    for run, name, panorama, canvas in zip(runs, names, panoramas, canvases, strict=True):
        difference = motion_difference(run.motion, runs[0].motion)
        if difference is None:
            raise InputError(f"{run.folder} and {runs[0].folder} located no frame in common, so that they cannot be compared")
        whites = (panorama["white_flux"], panoramas[0]["white_flux"]) if in_srgb else None
        picture = on_canvas(_picture(run.folder), canvas, difference.alignment, common, whites)
        scored = None if truth is None else evaluate(run.folder, truth)
        image = None if scored is None else scored.panorama
        found.append(
            ComparedRun(
                name,
                run.folder,
                run.record,
                picture,
                None if run is runs[0] else difference.corners_px,
                None if scored is None else scored.trajectory.mean_px,
                None if image is None else image.psnr_db,
                None if image is None else image.ssim,
            )
        )
    return found


def _panorama(run: _Run) -> PanoramaRecord:
    if (panorama := run.record["panorama"]) is None:
        raise InputError(f"{run.folder} has no panorama; give runs with one")
    return panorama


def _picture(folder: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(folder / "panorama.png"), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{folder / 'panorama.png'} cannot be read; run the spec again")
    return np.asarray(picture if picture.ndim == 2 else picture[..., 2::-1], np.uint8)
