"""Run folders: open a run with its capture and its motion, verify its files, and remove what killed processes have left."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from photonpano.api.batch_jobs import capture_override
from photonpano.api.command import command
from photonpano.capture import seen_through
from photonpano.contracts.protocols import Source
from photonpano.corrections import Vignette, divided_by, read_vignette
from photonpano.corrections.lighting import in_light_of
from photonpano.corrections.movers import before_background_of
from photonpano.errors import InputError, OutputError, SpecError
from photonpano.evaluation import RunTrajectory, load_run_trajectory
from photonpano.evaluation import load_panorama as read_panorama
from photonpano.evaluation.inputs import read_tiff
from photonpano.files.folders import NEW, OLD, in_use, is_lock, locked, recover, remove
from photonpano.files.paths import location
from photonpano.geometry import PROJECTIONS, FrameTrajectory
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import through_lens
from photonpano.pipeline.components import open_source
from photonpano.pipeline.state import model_of
from photonpano.plugins.registry import Catalog
from photonpano.reading import library
from photonpano.record.contents import (
    changed_files,
    changes,
    fingerprint,
    recorded_contents,
    require_one_run,
    require_same_frames,
)
from photonpano.record.run_json import read_record
from photonpano.record.schema import CaptureRecord, RunRecord
from photonpano.specs import Plan, parse_spec
from photonpano.text import byte_size, counted
from photonpano.values import FrameSpan, Panorama

if TYPE_CHECKING:
    import xarray

_OF_LOCKED = re.compile(rf"\.(.+)\.(lock|{NEW}|{OLD})")  # what the holder of a lock makes, and the file or folder that it locks
_PARTIAL = re.compile(r"\.(.+\.)?[0-9a-f]{8}\.partial(\.\w+)?")
_UNPACKED = re.compile(r"(.+\.(gz|npz|h5|hdf5|mat))\.unpacked(\..+)?\.npy")  # a file, and the array that was unpacked from it
_IDLE_S = 600.0  # an unfinished file to which nothing was written for this time is left over


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OpenedRun:
    """A finished run, with its capture."""

    folder: Path
    record: RunRecord
    plan: Plan
    capture: Source  # with the corrections of the spec
    source: Source  # the same, divided by the vignette, in the light and through the lens that the run found
    vignette: Vignette | None
    motion: FrameMotion  # of every frame


@contextmanager
def opened_run(
    folder: Path,
    catalog: Catalog | None = None,
    changes: Sequence[str] = (),
    output: Path | None = None,
    moved: Path | str | None = None,
) -> Iterator[OpenedRun]:
    """Open a finished run and its capture, with changes of its spec such as `render.scale=2`.

    `moved` is where the capture is now, if it is not where it was.

    Raises:
        InputError: the files are of several runs, or of none, or the capture cannot be opened or is another one now.
        SpecError: a change is wrong.
    """
    require_one_run(folder, ["trajectory.npz", "light.npz", "layers.npz", "vignette.npz"])
    run = load_run_trajectory(folder)
    record = read_record(folder)
    if moved is not None:
        changes = [*changes, capture_override(location(moved))]
    with _capture(folder, record, catalog, changes, output) as (plan, capture):
        stream, n_frames, (height, width) = capture.info, len(run.homographies), run.frame_shape
        if (stream.n_frames, *stream.frame_shape) != (n_frames, height, width):
            raise InputError(
                f"{folder} is a run of {n_frames:,} frames of {height}x{width}, but its capture now has {stream.n_frames:,} "
                f"frames of {stream.height}x{stream.width}; it is another capture"
            )
        if not run.located.any():
            raise InputError(f"{folder}: the run located no frame, so that it has no panorama")
        require_same_frames(folder, record, capture)
        vignette = read_vignette(folder, capture)
        lit = in_light_of(capture if vignette is None else divided_by(capture, vignette), folder)
        lit = before_background_of(lit, folder)
        source = through_lens(lit, model_of(plan)) if run.camera is None else seen_through(lit, run.camera)
        yield OpenedRun(
            folder=folder, record=record, plan=plan, capture=capture, source=source, vignette=vignette, motion=_motion(run)
        )


@contextmanager
def _capture(
    folder: Path, record: RunRecord, catalog: Catalog | None, changes: Sequence[str], output: Path | None
) -> Iterator[tuple[Plan, Source]]:
    """Open the capture of a run by the spec that the run recorded."""
    with ExitStack() as stack:
        try:
            plan = parse_spec(record["spec"], name=str(folder / "run.json"), catalog=catalog, overrides=changes, output=output)
            source = stack.enter_context(open_source(plan))
        except SpecError as error:
            if any(problem.override for problem in error.problems):
                raise
            problems = "; ".join(f"{problem.where}: {problem.message}" for problem in error.problems)
            raise InputError(
                f"{folder}: the capture of this run cannot be opened by its recorded spec ({problems}); if it was moved, "
                "name it with --capture PATH, or, where a command has --set, with --set source.with.path=PATH"
            ) from error
        yield plan, source


def _motion(run: RunTrajectory) -> FrameMotion:
    """Return the motion of a run. An expected error that the run did not record is 0."""
    known = np.flatnonzero(run.located)
    span = FrameSpan(int(known[0]), int(known[-1]) + 1)
    reference = int(np.abs(run.homographies - np.eye(3)).max(axis=(1, 2)).argmin())
    trajectory = FrameTrajectory(run.homographies)
    std_px = np.where(run.located, np.nan_to_num(run.std_px, posinf=np.inf), np.inf)
    return FrameMotion(
        trajectory=trajectory,
        span=span,
        homographies=run.homographies,
        located=run.located,
        std_px=std_px,
        reference=reference,
        frame_shape=run.frame_shape,
        camera=run.camera,
    )


def load_panorama(run_folder: Path | str) -> Panorama:
    """Read the panorama of a finished run: flux, weight and canvas.

    Args:
        run_folder: written by `run` or `render`.

    Raises:
        InputError: the folder is no run folder, or a file is missing or damaged.
    """
    folder = Path(run_folder)
    require_one_run(folder, ["trajectory.npz", "panorama.tiff", "coverage.tiff"])
    canvas = load_run_trajectory(folder).canvas
    return Panorama(*read_panorama(folder), canvas)


def load_trajectory(run_folder: Path | str) -> RunTrajectory:
    """Read the motion of a finished run: the homography of every frame, with its expected error.

    Args:
        run_folder: written by `run` or `render`.

    Raises:
        InputError: the folder is no run folder, or the file is missing or damaged.
    """
    folder = Path(run_folder)
    require_one_run(folder, ["trajectory.npz"])
    return load_run_trajectory(folder)


def load_xarray(run_folder: Path | str) -> xarray.Dataset:
    """Read the panorama of a finished run as a dataset of xarray: `flux`, its standard deviation `std`, and `coverage`.

    Dimensions are `y`, `x`, and `colour` where there is one. Coordinates are pixels of the reference frame, or degrees on a
    sphere; on a cylinder, x are degrees and y the tangent of the angle. The attribute `units` of each says which.

    Args:
        run_folder: written by `run` or `render`.

    Raises:
        InputError: xarray is not installed, the folder is no run folder, or a file is missing or damaged.
    """
    module = library("xarray", "photonpano[xarray]", "load_xarray")
    folder = Path(run_folder)
    panorama, motion = load_panorama(folder), load_run_trajectory(folder)
    (height, width), place, planar = panorama.flux.shape[:2], panorama.canvas, motion.projection == "planar"
    x, y = ((np.arange(side) - place[axis, 2]) / place[axis, axis] for axis, side in enumerate((width, height)))
    turns, of_canvas = PROJECTIONS[motion.projection].periodic, "radians in the middle"
    units = "px of the reference frame" if planar else "degrees" if turns else of_canvas
    down = {"planar": units, "spherical": units, "cylindrical": "tangent of the angle"}.get(motion.projection, of_canvas)
    coordinates: dict[str, object] = {
        "x": ("x", np.degrees(x) if turns else x, {"units": units}),
        "y": ("y", np.degrees(y) if motion.projection == "spherical" else y, {"units": down}),
    }
    dimensions = ("y", "x") if panorama.flux.ndim == 2 else ("y", "x", "colour")
    if panorama.flux.ndim > 2:
        coordinates["colour"] = ["red", "green", "blue"]
    photons = {"units": "photons per pixel per frame"}
    require_one_run(folder, ["panorama-std.tiff"])
    std = read_tiff(folder / "panorama-std.tiff")
    variables = {"flux": (panorama.flux, photons), "std": (std, photons), "coverage": (panorama.weight, {"units": "frames"})}
    found: xarray.Dataset = module.Dataset({name: (dimensions, *each) for name, each in variables.items()}, coordinates)
    return found


@dataclass(frozen=True, slots=True)
class Verification:
    """What `verify` found."""

    n_files: int  # number of files that were compared
    n_bytes: int  # their size
    problems: tuple[str, ...]  # what is not as the run left it, a clause each
    capture: str  # what became of the capture, if that is no problem: a clause
    folder: Path = Path()  # the run folder


def _lines_of_verification(found: Verification) -> Iterator[str]:
    if found.problems:
        raise InputError(f"{found.folder} is not as its run wrote it: {'; '.join(found.problems)}")
    yield f"files     {counted(found.n_files, 'file')}, {byte_size(found.n_bytes)}, as the run wrote them"
    yield f"capture   {found.capture}"


@command("runs/first", _lines_of_verification)
def verify(run_folder: Path | str, catalog: Catalog | None = None) -> Verification:
    """Verify that a run folder is as its run wrote it.

    Compares the size and SHA-256 of each file with `run.json`, and the capture with its fingerprint there.

    Args:
        run_folder: written by `run`.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        InputError: the folder is no run folder.
    """
    folder = Path(run_folder)
    record = read_record(folder)
    recorded = recorded_contents(folder)
    problems = [] if recorded else ["run.json lists no files"]
    problems += [f"{name} is missing" for name in recorded if not os.path.lexists(folder / name)]
    problems += [f"{name} is not the file that the run wrote" for name in changed_files(folder)]
    others, capture = _recorded_capture(folder, record["spec"], record.get("capture"), catalog)
    size = sum(content["bytes"] for content in recorded.values())
    return Verification(len(recorded), size, (*problems, *others), capture, folder)


def _recorded_capture(folder: Path, spec: object, old: CaptureRecord | None, catalog: Catalog | None) -> tuple[list[str], str]:
    """Return the problems of the capture; and if there are none, what became of it."""
    if old is None:
        return [], "not compared: run.json has no fingerprint of it"
    try:
        plan = parse_spec(spec, name=str(folder / "run.json"), catalog=catalog)  # type: ignore[arg-type]  # checked there
        with open_source(plan) as source:
            new = fingerprint(plan, source)
    except SpecError as error:
        return [], f"not compared: {error.problems[0].message}"
    except InputError as error:
        return [], f"not compared: {error}"
    found = changes(old, new)
    sizes = [[(file["path"], file["bytes"]) for file in record["files"]] for record in (old, new)]
    same = sizes[0] == sizes[1] and all(old[key] == new[key] for key in ("frames_sha256", "pixels_sha256"))
    return ([], "; ".join(["the same frames", *found])) if same else (found, "")


def _lines_of_clean(found: list[Path], *, dry_run: bool = False) -> Iterator[str]:
    yield from map(str, found)
    yield f"{counted(len(found), 'leftover')} {'found' if dry_run else 'removed'}"


@command(
    ". --dry-run",
    _lines_of_clean,
    directory=typer.Argument(metavar="DIR", help="A folder with captures or run folders."),
    dry_run=typer.Option("--dry-run", "-n"),
)
def clean(directory: Path | str, dry_run: bool = False) -> list[Path]:
    """Remove what killed processes have left in a folder and those in it: unfinished files, locks, unpacked archives.

    A folder that was put aside, and has no successor, is put back. An unfinished file is removed if nothing was written to it
    for ten minutes, an unpacked archive if the archive is there, from which it can be unpacked again. What is locked is left
    alone, and unfinished conversions (`.part`) are kept, since `convert` continues them.

    Args:
        directory: symbolic links in it are not followed.
        dry_run: list what would be removed, and remove nothing.

    Returns:
        What was removed, or would be.

    Raises:
        InputError: there is no such folder.
    """
    folder = Path(directory)
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; check the path")
    found = list(_leftovers(folder))
    for path in () if dry_run else found:
        if (locks := _locked_by(path)) is None:
            remove(path)
        else:
            with suppress(OutputError), locked(locks, str(locks)):  # the lock file goes with the lock
                recover(locks)
    return found


def _leftovers(folder: Path) -> Iterator[Path]:
    for inside, folders, files in os.walk(folder):
        named = [name for name in (*folders, *files) if _is_leftover(Path(inside, name))]
        folders[:] = [name for name in folders if name not in named]
        yield from (Path(inside, name) for name in sorted(named))


def _is_leftover(path: Path) -> bool:
    if path.is_symlink():
        return False
    if (locks := _locked_by(path)) is not None:
        return not in_use(locks) and (path.is_dir() or is_lock(path))
    if archive := _UNPACKED.fullmatch(path.name):
        return path.with_name(archive[1]).is_file()
    return _PARTIAL.fullmatch(path.name) is not None and time.time() - path.stat().st_mtime > _IDLE_S


def _locked_by(path: Path) -> Path | None:
    """Return the file or folder whose lock protects what has this name; None for another name."""
    found = _OF_LOCKED.fullmatch(path.name)
    return None if found is None else path.with_name(found[1])
