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
from photonpano.atomic import atomic_path
from photonpano.captures.writing import truth_path
from photonpano.errors import InputError, OutputError
from photonpano.evaluation import evaluate, load_run_trajectory
from photonpano.evaluation.comparison import motion_difference, on_canvas, reduced
from photonpano.evaluation.inputs import RunTrajectory
from photonpano.record.contents import require_one_run
from photonpano.record.run_json import read_record
from photonpano.record.schema import RunRecord
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
def compare(runs: Sequence[Path | str], output: Path | str = "compare.html", truth: Path | str | None = None) -> Comparison:
    """Lay runs of one capture side by side, on a page of its own: motion, panoramas, scores, and settings that differ.

    Captures are not opened. The first run is the one that the others are compared with.

    Args:
        runs: at least two run folders.
        output: the page, whose name ends in .html; one that is there is replaced.
        truth: the `.truth.npz` of a simulated capture, for scores; by default the one beside the capture, if it is there.

    Raises:
        InputError: a folder is no run with a panorama, the runs are of different captures, or two of them located no frame in
            common; or the truth is that of another capture.
        OutputError: the page cannot be written, or its name has another ending.
    """
    folders, page = [Path(run) for run in runs], Path(output)
    if page.suffix != ".html":  # so that no file of another kind is replaced by mistake
        raise OutputError(f"cannot write {output}: the page is HTML; choose a name that ends in .html")
    if len({folder.absolute().resolve() for folder in folders}) < max(2, len(folders)):
        raise InputError("a comparison needs at least two different run folders")
    records = [_record(folder) for folder in folders]
    motions = [load_run_trajectory(folder) for folder in folders]
    for folder, record, motion in zip(folders[1:], records[1:], motions[1:], strict=True):
        _require_same_capture((folders[0], records[0], motions[0]), (folder, record, motion))
    names = _names(folders)
    compared = _compared(folders, records, motions, names, _truth(truth, records[0]))
    with atomic_path(page) as temporary:
        temporary.write_text(render_comparison(compared, page), encoding="utf-8")
    return Comparison(page, tuple(names), tuple(run.mean_difference_px for run in compared))


def _record(folder: Path) -> RunRecord:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; give the run folders that `photonpano run` wrote")
    require_one_run(folder, list(_FILES))
    return read_record(folder)


def _require_same_capture(first: tuple[Path, RunRecord, RunTrajectory], other: tuple[Path, RunRecord, RunTrajectory]) -> None:
    """Refuse runs whose frames are not the same."""
    one, another = ((record.get("capture") or {}).get("frames_sha256") for _, record, _ in (first, other))
    same = len(first[2].homographies) == len(other[2].homographies) and (one == another or None in (one, another))
    if not same:
        described = [f"{folder} is a run of {_capture(record)}" for folder, record, _ in (first, other)]
        raise InputError(f"{' and '.join(described)}: these are different captures; compare runs of one capture")
    if first[2].frame_shape != other[2].frame_shape:
        described = [
            f"{folder} has frames of {motion.frame_shape[0]}x{motion.frame_shape[1]}" for folder, _, motion in (first, other)
        ]
        raise InputError(f"{' and '.join(described)}, after other corrections; compare runs with the same frames")


def _capture(record: RunRecord) -> str:
    """Name the capture of a run: its file, and the number of its frames."""
    files = (record.get("capture") or {}).get("files") or ()
    name = Path(files[0]["path"]).name if files else "a capture without a file"
    return f"{name} ({record['source']['n_frames']:,} frames)"


def _names(folders: Sequence[Path]) -> list[str]:
    """Return the shortest ends of the paths that are different."""
    parts = [folder.absolute().resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(each[-length:]) for each in parts]
        if len(set(names)) == len(names):
            break
    return names


def _truth(given: Path | str | None, record: RunRecord) -> Path | None:
    """Return the truth that was given, or that lies beside the capture."""
    if given is not None:
        return Path(given)
    files = (record.get("capture") or {}).get("files") or ()
    beside = truth_path(Path(files[0]["path"])) if len(files) else None
    return beside if beside is not None and beside.is_file() else None


def _compared(
    folders: Sequence[Path],
    records: Sequence[RunRecord],
    motions: Sequence[RunTrajectory],
    names: Sequence[str],
    truth: Path | None,
) -> list[ComparedRun]:
    """Align each run with the first, and score it."""
    shapes = [_shape(record, folder) for record, folder in zip(records, folders, strict=True)]
    canvases = [motion.canvas_of(shape) for motion, shape in zip(motions, shapes, strict=True)]
    common = reduced(canvases[0], _PICTURE_PIXELS)
    in_srgb = all(((record["spec"].get("render") or {}).get("tone") or "srgb") == "srgb" for record in records)
    white = _white(records[0])
    found = []
    for folder, record, motion, name, canvas in zip(folders, records, motions, names, canvases, strict=True):
        difference = motion_difference(motion, motions[0])
        if difference is None:
            raise InputError(f"{folder} and {folders[0]} located no frame in common, so that they cannot be compared")
        whites = (_white(record), white) if in_srgb else None
        picture = on_canvas(_picture(folder), canvas, difference.alignment, common, whites)
        scored = None if truth is None else evaluate(folder, truth)
        image = None if scored is None else scored.panorama
        found.append(
            ComparedRun(
                name,
                folder,
                record,
                picture,
                None if folder is folders[0] else difference.corners_px,
                None if scored is None else scored.trajectory.mean_px,
                None if image is None else image.psnr_db,
                None if image is None else image.ssim,
            )
        )
    return found


def _shape(record: RunRecord, folder: Path) -> tuple[int, int]:
    panorama = record["panorama"]
    if panorama is None:
        raise InputError(f"{folder} has no panorama; give runs with one")
    return panorama["height"], panorama["width"]


def _white(record: RunRecord) -> float:
    panorama = record["panorama"]
    assert panorama is not None
    return panorama["white_flux"]


def _picture(folder: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(folder / "panorama.png"), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{folder / 'panorama.png'} cannot be read; run the spec again")
    return np.asarray(picture if picture.ndim == 2 else picture[..., 2::-1], np.uint8)
