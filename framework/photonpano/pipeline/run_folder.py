"""The run folder: it is locked, and replaced as a whole; and the exposures of levels that are kept in it."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from photonpano.errors import OutputError
from photonpano.execution.context import Context
from photonpano.execution.threads import in_order
from photonpano.files.folders import flush, others_in, replace_folder, require_harmless, staging_of
from photonpano.geometry import Canvas
from photonpano.merging.panorama import RenderedPanorama, Tile
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import LevelResult
from photonpano.photometry import tone_mapped
from photonpano.record.contents import MAPS, RECORD, REPORT, content_of, contents_of, names_of_results, recorded_json
from photonpano.record.picture_files import photo_sphere, png_of, png_with_holes, with_xmp
from photonpano.record.schema import RunRecord

SHOWN_FILES = 3  # files that a message names


class RunFolder:
    """A folder, `staging`, in which the files of a run are gathered, and from which they replace those of the run before."""

    def __init__(self, directory: Path, staging: Path) -> None:
        self.directory, self.staging = directory, staging

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Make errors of writing files in the block an `OutputError`."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or "a file was cut short"  # a short write of an array comes without the system's words
            raise OutputError(
                f"{self.directory}: the results could not be written ({reason}); what was there before is unchanged. "
                "Make room, or choose another folder with --output"
            ) from error

    def write_tile(self, tile: Tile, maps: Sequence[NDArray[Any]], canvas: Canvas, capture: str) -> None:
        """Write parts of the `MAPS` of a panorama, which make up the canvas, as TIFF that says what it holds, and of what."""
        with self.writing():
            for (name, content), image in zip(MAPS.items(), maps, strict=True):
                about = {"content": content, "pixels_per_frame_pixel": canvas.scale, "capture": capture}
                _write_box(self.staging / name, image, tile, canvas=canvas, about=about)

    def write_results(self, panorama: RenderedPanorama, motion: FrameMotion) -> None:
        """Write panorama.png (8 bits, sRGB) and trajectory.npz."""
        sphere = photo_sphere(panorama.canvas, panorama.picture.shape[:2])
        flux = panorama.thumbnail.flux
        unseen = np.isnan(flux).reshape(*flux.shape[:2], -1).all(axis=-1)
        png = png_with_holes(panorama.picture, np.asarray(unseen))
        with self.writing():
            (self.staging / "panorama.png").write_bytes(png if sphere is None else with_xmp(png, sphere))
            motion_arrays: dict[str, Any] = {
                "homographies": motion.homographies,
                "canvas": panorama.canvas.transform,
                "projection": np.array(panorama.canvas.projection),
                "horizon": np.eye(3) if panorama.canvas.horizon is None else panorama.canvas.horizon,
                "frame_shape": np.array(motion.frame_shape),
                "reference": np.array(motion.reference),
                "located": motion.located,
                "std_px": motion.std_px,
            }
            np.savez(self.staging / "trajectory.npz", allow_pickle=False, **motion_arrays, **_of_camera(motion))

    def commit(self, record: RunRecord) -> RunRecord:
        """Make the written files and run.json those of the run folder; return the record with sizes and hashes."""
        with self.writing():
            record = {**record, "files": contents_of(self.staging)}
            (self.staging / RECORD).write_text(_written(record), encoding="utf-8")
            replace_folder(self.staging, self.directory, names_of_results(self.directory))
        return record

    def add_report(self, page: str) -> None:
        """Write report.html beside the committed files; `update` lists it in run.json."""
        self._put(REPORT, page)

    def update(self, record: RunRecord) -> RunRecord:
        """Write run.json of the committed files again, with the report if there is one; return the record."""
        report = self.directory / REPORT
        if report.exists():
            record = {**record, "files": {**record["files"], REPORT: content_of(report)}}
        self._put(RECORD, _written(record))
        return record

    def _put(self, name: str, text: str) -> None:
        """Write a file of the committed ones, whole or not at all."""
        with self.writing():
            self.staging.mkdir(exist_ok=True)
            path = self.staging / name
            path.write_text(text, encoding="utf-8")
            flush(path)
            path.replace(self.directory / name)


def _written(record: RunRecord) -> str:
    return json.dumps(record, indent=2, allow_nan=False) + "\n"


@contextmanager
def run_folder(directory: Path, *, overwrite: bool = False, inputs: Sequence[Path] = ()) -> Iterator[RunFolder]:
    """Lock a run folder, which may be missing, and gather the files of a run beside it.

    The place is proved to be writable before the work starts. When the block raises before `commit`, what was there stays as it
    was, and folders that were not there are gone again.

    With `overwrite`, it may hold files that no run has written, which stay, or a run of another capture. `inputs` are what the
    run reads, which must not lie in it.

    Raises:
        OutputError: the folder cannot be made or written to, another process writes it, or it is none that a run may write.
    """
    directory = _resolved(directory)
    require_harmless(directory, inputs)
    with ExitStack() as stack:
        try:
            stack.enter_context(_made(directory.parent))
            if directory.exists() and not directory.is_dir():
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
            staging = stack.enter_context(staging_of(directory, f"the run folder {directory}"))
            if not overwrite and directory.is_dir():
                _require_own(directory)
                _require_same_capture(directory, inputs)
        except OSError as error:
            raise OutputError(
                f"{directory}: the run folder cannot be written to ({error.strerror}); choose another one with --output"
            ) from error
        _require_temporary(directory.parent)
        yield RunFolder(directory, staging)


def _require_temporary(folder: Path) -> None:
    """Let temporary files lie in a folder where the system has no place for them, as in a container that is read-only."""
    try:
        tempfile.gettempdir()
    except FileNotFoundError:
        tempfile.tempdir = str(folder)


def _of_camera(motion: FrameMotion) -> dict[str, NDArray[Any]]:
    """Return what the archive of the motion holds beside the homographies, for a camera that only turns."""
    rotations = motion.rotations
    if motion.camera is None or rotations is None:
        return {}
    return {
        "model": np.array("rotation"),
        "rotations": rotations,
        "camera_matrix": motion.camera.matrix,
        "distortion": motion.camera.distortion,
    }


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder, and remove it after the block if it is empty."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    if made:
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with suppress(OSError):  # the results are in it, or those of another program
            for each in made:
                each.rmdir()


def _resolved(directory: Path) -> Path:
    """Return the path without symbolic links: what a link points to is replaced, not the link."""
    try:
        return directory.absolute().resolve()
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{directory}: the run folder cannot be found ({error}); choose another one with --output") from error


def _require_own(directory: Path) -> None:
    """Refuse a folder with files that no run has written."""
    own = names_of_results(directory) if recorded_json(directory) else set()
    others = sorted(path.relative_to(directory).as_posix() for path in others_in(directory, own))
    if others:
        more = f" and {len(others) - SHOWN_FILES} more" if len(others) > SHOWN_FILES else ""
        raise OutputError(
            f"{directory} holds files that no run has written: {', '.join(others[:SHOWN_FILES])}{more}; choose another folder "
            "with --output, or write the results among them with --overwrite"
        )


def _require_same_capture(directory: Path, inputs: Sequence[Path]) -> None:
    """Refuse a folder with a run of another capture, which still is where it was."""
    for file in ((recorded_json(directory) or {}).get("capture") or {}).get("files") or ():
        path = Path(file["path"])
        if path.exists() and not any(other.exists() and path.samefile(other) for other in inputs):
            raise OutputError(
                f"{directory} holds a run of another capture, {path}; choose another folder with --output, or replace that run "
                "with --overwrite"
            )
        return  # the others are files of corrections


def _write_box(path: Path, image: NDArray[Any], tile: Tile, *, canvas: Canvas, about: dict[str, Any]) -> None:
    """Write a box of pixels into a TIFF file, which the first one lays out; (H, W, 3) as red, green and blue of each pixel."""
    pixel = int(np.prod(image.shape[2:]))
    if not path.exists():
        room = 4 * canvas.height * canvas.width * pixel
        if room > shutil.disk_usage(path.parent).free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        shape, kind = (*canvas.shape, *image.shape[2:]), "minisblack" if image.ndim == 2 else "rgb"
        tifffile.imwrite(path, shape=shape, dtype=image.dtype, photometric=kind, metadata=about)
    with tifffile.TiffFile(path) as file:
        start = file.pages.first.dataoffsets[0]
    with path.open("rb+") as stream:
        if image.shape[1] == canvas.width:
            stream.seek(start + 4 * pixel * tile.top * canvas.width)
            image.tofile(stream)
            return
        for row, pixels in enumerate(image, start=tile.top):
            stream.seek(start + 4 * pixel * (row * canvas.width + tile.left))
            pixels.tofile(stream)


def write_exposures(folder: Path, levels: Sequence[LevelResult], white_flux: float, context: Context) -> None:
    """Merge the exposures of each level again, as they were located, and write them.

    For each level, `exposures/level-1.npy` is (N, H, W) float32, `exposures/level-1.npz` describes its exposures, and
    `exposures/level-1-0012.png` is a picture of the one of number 12, from 0. Raises `OSError` if the disk is full.
    """
    exposures = folder / "exposures"
    exposures.mkdir()
    for result in levels:
        _write_level(exposures, result, white_flux, context)


def _write_level(folder: Path, result: LevelResult, white_flux: float, context: Context) -> None:
    name, groups = f"level-{result.level.number}", result.groups
    digits = len(str(len(groups) - 1))
    exposures = in_order(result.exposures.merged, range(len(groups)), context.threads)
    title = f"exposures of level {result.level.number}"
    with (folder / f"{name}.npy").open("wb") as file, context.progress.stage(title, len(groups), "exposures") as advance:
        for number, exposure in enumerate(exposures):
            if not file.tell():
                head = {"descr": "<f4", "fortran_order": False, "shape": (len(groups), *exposure.flux.shape)}
                np.lib.format.write_array_header_1_0(file, head)
            file.write(np.ascontiguousarray(exposure.flux, "<f4").tobytes())
            (folder / f"{name}-{number:0{digits}}.png").write_bytes(png_of(tone_mapped(exposure.flux, white_flux)))
            advance(1)
    instants = np.array([group.reference for group in groups])
    np.savez(
        folder / f"{name}.npz",
        allow_pickle=False,
        frames=np.array([[group.span.start, group.span.stop] for group in groups]),
        instants=instants,
        located=result.located.solution.located,
        homographies=result.trajectory.at(instants),
        scale=np.array(result.level.scale),
    )
