"""Judge finished runs: by their capture, by the truth of a capture, and side by side."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from photonpano.api.command import command, json_lines, logger, require_trust, verdict_lines
from photonpano.api.run_folders import opened_run
from photonpano.capture import capture_of
from photonpano.capture.writing import truth_path
from photonpano.contracts.protocols import Score, Trajectory
from photonpano.errors import InputError, OutputError
from photonpano.evaluation import Evaluation, load_run_trajectory
from photonpano.evaluation import evaluate as evaluate_folder
from photonpano.evaluation.inputs import RunTrajectory, kind_of_run, load_truth
from photonpano.evaluation.run_scores import motion_difference, on_canvas, reduced
from photonpano.execution.context import Context, Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import atomic_path, require_new
from photonpano.geometry import Canvas
from photonpano.merging.colour import composed
from photonpano.merging.panorama import render
from photonpano.pipeline.obstacles import timeline_of
from photonpano.pipeline.rendering import build_renderer
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import require_one_run
from photonpano.record.run_json import findings_of, read_record
from photonpano.record.schema import PanoramaRecord, RunRecord
from photonpano.report import ComparedRun, render_comparison
from photonpano.residuals.refinement import MotionFit
from photonpano.residuals.verdict import NARROW, REPEATS, judge
from photonpano.text import columns
from photonpano.values import Panorama, Reason, Verdict

_PICTURE_PIXELS = 1600  # longer side of a panorama on the page
_FILES = ("trajectory.npz", "panorama.png")


@dataclass(frozen=True, slots=True)
class RunCheck:
    """What `check_run` found.

    Attributes:
        verdict: whether motion and panorama explain the photons.
    """

    verdict: Verdict


def _lines_of_check(found: RunCheck, *, strict: bool = False) -> Iterator[str]:
    yield from verdict_lines(found.verdict)
    ratio = found.verdict.residual_ratio
    yield f"scatter   {'unknown: too few frames' if ratio is None else f'{ratio:.2f} times what noise explains'}"
    if strict:
        require_trust(found.verdict, "nothing was written")


@command("runs/first --strict", _lines_of_check)
def check_run(
    run_folder: Path | str,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
    *,
    capture: Path | str | None = None,
) -> RunCheck:
    """Judge a finished run: render the panorama along its motion, and compare it with the photons of the capture.

    Writes nothing. The panorama is rendered with the scale of the frames, whatever that of the run was. What only the loop can
    find, such as pairs that fit at several places, is taken from the record.

    Args:
        run_folder: written by `run`.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.
        capture: the capture, if it is not where the run has read it: a file, a folder, or a URL.

    Raises:
        InputError: the folder is no run folder, its capture cannot be opened, or it is another capture now.
    """
    with opened_run(Path(run_folder), catalog, moved=capture) as opened, one_thread_inside():
        record, plan = opened.record, opened.plan
        context = Context(threads=thread_count(plan.run.threads), progress=usual(progress))
        findings = findings_of(record)
        copies = timeline_of(opened.source, context).copies if findings.repeated else None
        source = replace(capture_of(opened.source), copies=copies)
        fit = MotionFit(source, opened.motion, int(plan.run.memory), context)
        explained = fit.explained()
    verdict = judge(explained, (), findings)
    reasons = list(verdict.reasons)
    recorded = (record.get("verdict") or {"reasons": ()})["reasons"]
    reasons += [Reason(**each) for each in recorded if each["what"] in (REPEATS, NARROW)]
    judged = Verdict.of(reasons, verdict.residual_ratio, verdict.untested, verdict.notes)
    return RunCheck(replace(judged, reduced_chi2=verdict.reduced_chi2))


def _score(run_folder: Path, truth: Path, **how: Any) -> Score:
    """Score a panorama, or what another kind of run has found."""
    kind = kind_of_run(run_folder)
    return evaluate(run_folder, truth, **how) if kind is None else kind.runs.evaluate(run_folder, truth)


def _lines_of_score(score: Score, *, as_json: bool = False) -> Iterable[str]:
    return json_lines(score.data()) if as_json else [columns(score.rows())]


@command(
    "runs/scan --truth cube.truth.npz",
    _lines_of_score,
    calls=_score,
    truth=typer.Option(metavar="TRUTH.npz"),
    oracle=typer.Option("--oracle/--no-oracle"),
)
def evaluate(
    run_folder: Path | str,
    truth: Path | str,
    oracle: bool = True,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
    *,
    capture: Path | str | None = None,
) -> Evaluation:
    """Score a run folder against the truth of its capture.

    Corner errors are in px of a frame, over the located frames, after the best alignment of both reference planes. Those of
    rotations are angles, after the best common rotation. PSNR and SSIM compare the panorama with the true scene, where it was
    seen. The oracle is the panorama along the true motion.

    Of another kind of run, the plugin that offers it says what is scored.

    Args:
        run_folder: written by `run`.
        truth: the `.truth.npz` that was simulated with the capture.
        oracle: also render the capture along the true motion, and score that; opens the capture again.
        progress: receives the stages of that; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.
        capture: the capture, if it is not where the run has read it: a file, a folder, or a URL.

    Raises:
        InputError: a file is missing or damaged, or run and truth are not of the same capture.
    """
    if not oracle:
        return evaluate_folder(run_folder, truth)
    with opened_run(Path(run_folder), catalog, moved=capture) as opened:

        def along_truth(trajectory: Trajectory, canvas: Canvas) -> Panorama:
            source, plan = opened.source, opened.plan
            context = Context(threads=thread_count(plan.run.threads), progress=usual(progress))
            renderer = build_renderer(plan, source, [])
            images = render(
                source,
                trajectory,
                source.info.span,
                canvas,
                tolerance_px=plan.render.tolerance_px,
                context=context,
                renderer=renderer,
            )
            return composed(images, source)

        return evaluate_folder(run_folder, truth, along_truth)


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


def _lines_of_comparison(found: Comparison) -> Iterator[str]:
    _, *means = found.mean_difference_px
    differences = [f"{mean:.3g} px from it on average" if mean else "the same motion" for mean in means]
    yield columns([*zip(found.runs, ["the motion to compare with", *differences], strict=True)])
    yield f"page  {found.page.resolve()}"


@command(
    "runs/first runs/second --output compare.html",
    _lines_of_comparison,
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
    compared = _compared(runs_read, names, _truth(truth, runs_read))
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


def _truth(given: Path | str | None, runs: Sequence[_Run]) -> Path | None:
    """Return the truth that was given, or that lies beside the capture of runs and is one of theirs."""
    if given is not None:
        return Path(given)
    beside = next((beside for file in runs[0].files[:1] if (beside := truth_path(file)).is_file()), None)
    try:
        if beside is not None and len(load_truth(beside).homographies) == len(runs[0].motion.homographies):
            return beside
    except InputError as error:
        logger.warning(f"{error}; the runs are compared without it")
    return None


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
        scored = None if truth is None else evaluate_folder(run.folder, truth)
        image = None if scored is None else scored.panorama
        found.append(
            ComparedRun(
                name=name,
                folder=run.folder,
                record=run.record,
                picture=picture,
                difference_px=None if run is runs[0] else difference.corners_px,
                corner_error_px=None if scored is None else scored.trajectory.mean_px,
                psnr_db=None if image is None else image.psnr_db,
                ssim=None if image is None else image.ssim,
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
