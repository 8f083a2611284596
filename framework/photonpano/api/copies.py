"""Read all frames of a capture: convert them to another file, or measure dark counts with the lens covered."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any
from zipfile import ZipFile

import numpy as np
import typer
from rich.filesize import decimal

from photonpano.api.command import command, warn
from photonpano.capture import capture_of
from photonpano.capture.writing import truth_path, write_folder, write_packed
from photonpano.contracts.protocols import Source
from photonpano.corrections import hot_in_the_dark, measure_dark, write_dark
from photonpano.corrections.dark import THRESHOLD
from photonpano.errors import InputError, OutputError
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import thread_count
from photonpano.files.folders import atomic_path, part_path, require_new
from photonpano.notebooks import facts
from photonpano.pipeline.components import build_source
from photonpano.plugins.contributions import SourceContribution
from photonpano.plugins.description import flow
from photonpano.plugins.registry import Catalog, discover
from photonpano.record.contents import capture_files
from photonpano.specs import Plan
from photonpano.specs.components import written_corrections
from photonpano.text import columns, counted
from photonpano.values import BoolArray, FluxImage, StreamInfo

BRIGHT = 0.1  # median photons per frame above which a binary capture was not recorded with the lens covered


@dataclass(frozen=True, slots=True)
class WrittenCapture:
    """A packed .npy file, or a folder such as a zarr array, written by `convert` or `simulate`.

    Attributes:
        path: the file or folder.
        truth: the file beside it with the true motion and scene, if the source knows them.
        info: the size and rate of the capture.
        n_masked: how many pixels are masked, in all frames or in some; the file holds no mask.
        source: the section of a spec that reads the file.
        sharp: the folder with pictures of frames without noise, if they were asked for.
    """

    path: Path
    truth: Path | None
    info: StreamInfo
    n_masked: int
    source: Mapping[str, Any]
    sharp: Path | None = None

    def _repr_html_(self) -> str:
        files = {"capture": self.path, "truth": self.truth, "frames without noise": self.sharp}
        rows = [(name, str(path)) for name, path in files.items() if path]
        return facts([*rows, ("frames", str(self.info)), ("source", str(dict(self.source)))])


def lines_of_capture(written: WrittenCapture) -> Iterator[str]:
    """Yield the lines that name the files that were written, and the spec that reads them."""
    if written.n_masked:
        mask = "mask them with `corrections`"
        warn(f"{written.n_masked} pixels of the capture are masked, and {written.path} holds no mask; {mask}")
    held = ZipFile(written.truth).namelist() if written.truth else ()
    known = "motion" if {*held} <= {"homographies.npy", "frame_shape.npy"} else "motion and scene"
    files = [(written.path, str(written.info)), (written.truth, f"the truth: {known}")]
    if written.sharp:
        files.append((written.sharp, f"{counted(len(list(written.sharp.iterdir())), 'frame')} without noise"))
    yield columns([[str(file), decimal(_size(file)), text] for file, text in files if file])
    yield f"\nIn a spec in this folder:\n\nsource: {flow(dict(written.source))}"
    others = [(kind.truth, f"run with `{kind.section}`") for kind in discover().run_kinds.values()]
    for array, kind in (("homographies", "run"), *others):
        if f"{array}.npy" in held:
            yield f"\nTo score a {kind} of it: photonpano evaluate RUN --truth {quote(str(written.truth))}"


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))


@command(
    "recording/ cube.npy --with frame_rate_hz=96800",
    lines_of_capture,
    plan="capture",
    notes=True,
    output=typer.Argument(metavar="OUTPUT"),
)
def convert(
    plan: Plan,
    output: Path | str,
    progress: Progress | None = None,
    resumed: Callable[[int], object] | None = None,
    *,
    compress: bool = False,
    overwrite: bool = False,
    catalog: Catalog | None = None,
) -> WrittenCapture:
    """Write a capture of binary frames to a packed .npy file, or to a zarr array.

    Eight pixels are packed into a byte. The only corrections are those of the plan. When writing a .npy file is interrupted,
    the frames written so far stay in OUTPUT.part; the next call compares them with the capture, and continues from there. A
    zarr array is written whole or not at all.

    Args:
        plan: of the capture, from `capture_plan` or `load_spec`; its corrections are applied.
        output: the .npy file, such as cube.npy; or a folder whose name ends as those that a source writes, such as cube.zarr.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.
        resumed: called with the number of frames that OUTPUT.part holds, if there are any.
        compress: compress the frames, in a format that can, such as zarr.
        overwrite: replace the files that are there under these names.
        catalog: the sources that may write it; by default those of the installed plugins.

    Raises:
        InputError: the frames are not binary, or a correction changes sums of frames, which bits cannot hold.
        OutputError: the file is there already, or cannot be written; the disk is full, or OUTPUT.part is another file.
    """
    output = Path(output)
    writer = writer_of(output, discover() if catalog is None else catalog)
    if writer is None and compress:
        raise OutputError(f"cannot compress {output}: packed .npy files are not compressed; name it {output.stem}.zarr")
    part, progress = part_path(output), usual(progress)

    def goes_on(n_frames: int) -> None:
        progress.note(f"{part} holds {n_frames:,} frames of this capture: continuing from there")
        if resumed is not None:
            resumed(n_frames)

    before = part.stat().st_mtime_ns if part.exists() else None
    try:
        with build_source(plan) as source:
            require_new_capture(source, plan, output, overwrite)
            return write_capture(source, plan, output, progress=progress, resumed=goes_on, writer=writer, compressed=compress)
    finally:
        if part.exists() and part.stat().st_mtime_ns != before:
            progress.note(f"the frames written so far are in {part}; the same command continues from there")


def writer_of(output: Path, catalog: Catalog) -> SourceContribution | None:
    """Return the source that writes a folder of such a name; None for any other name."""
    for entry in catalog.rows:
        source = entry.contribution
        if isinstance(source, SourceContribution) and source.write and output.suffix.lower() in source.suffixes:
            return source
    return None


def require_new_capture(source: Source, plan: Plan, output: Path, overwrite: bool) -> None:
    """Refuse names of a capture and its truth under which there is something, unless it is to be overwritten.

    The truth of one capture must not stay beside another one.
    """
    files, truth = capture_files(plan), truth_path(output)
    require_new(output, overwrite, files)
    if not capture_of(source).knows_truth and truth.absolute() in map(truth_path, files):
        return  # it is the truth of the frames that are converted
    require_new(truth, overwrite, files)
    if truth.exists() and not capture_of(source).knows_truth:
        raise OutputError(
            f"{truth} is the truth of the capture that {output} would replace; move it away, or choose another name"
        )


def write_capture(
    source: Source,
    plan: Plan,
    output: Path,
    *,
    progress: Progress | None,
    resumed: Callable[[int], object] | None,
    writer: SourceContribution | None = None,
    compressed: bool = False,
) -> WrittenCapture:
    """Write the frames of a source to a packed file, or with the source that writes such folders."""
    info, threads = source.info, thread_count(plan.run.threads)
    n_masked = int((~capture_of(source).masked_in(info.span).valid).sum())
    with usual(progress).stage(f"writing {output.name}", info.n_frames, "frames") as advance:
        if writer is not None and (write := writer.write) is not None:
            folder, *truth = write_folder(source, output, partial(write, compressed=compressed), advance, threads)
            section = {"use": writer.name, "with": {"path": str(folder)}}
            return WrittenCapture(folder, truth[0] if truth else None, info, n_masked, section)
        path, *truth = write_packed(source, output, advance, threads, resumed)
    keys: dict[str, Any] = {"path": str(path)}
    if info.frame_rate_hz is not None:
        keys["frame_rate_hz"] = info.frame_rate_hz
    if info.width % 8:
        keys["width"] = info.width
    return WrittenCapture(path, truth[0] if truth else None, info, n_masked, {"use": "packed-npy", "with": keys})


@dataclass(frozen=True, slots=True, eq=False)
class DarkMeasurement:
    """Dark counts and hot pixels, measured by `dark`.

    Attributes:
        path: the file that was written.
        info: the size and rate of the capture.
        rates: (H, W) float32, dark counts per frame.
        valid: (H, W) bool, the pixels that are not masked.
        hot: (H, W) bool, the valid pixels that are hot.
        limit: the rate above which a pixel is hot.
        corrections: the corrections of a spec for this camera: those of the plan, then those that use the file.
        warnings: what is wrong with the capture, a sentence each.
    """

    path: Path
    info: StreamInfo
    rates: FluxImage
    valid: BoolArray
    hot: BoolArray
    limit: float
    corrections: Sequence[Any]
    warnings: tuple[str, ...]


def _lines(measured: DarkMeasurement) -> Iterator[str]:
    for warning in measured.warnings:
        warn(warning)
    rates = measured.rates[measured.valid]
    median, p90, p99, highest = np.quantile(rates, [0.5, 0.9, 0.99, 1]).tolist()
    n_hot, n_pixels = int(measured.hot.sum()), rates.size
    rows = [
        [str(measured.path), f"from {measured.info}"],
        ["dark counts per frame", f"median {median:.2g}, 90 % {p90:.2g}, 99 % {p99:.2g}, highest {highest:.2g}"],
        ["hot pixels", f"{n_hot:,} of {n_pixels:,} ({100 * n_hot / n_pixels:.2f} %), above {measured.limit:.2g}"],
    ]
    yield columns(rows)
    yield f"\nIn a spec in this folder:\n\ncorrections: {flow(list(measured.corrections))}"


@command(
    "covered.npy --output dark.npz",
    _lines,
    plan="capture",
    output=typer.Option("--output", "-o", metavar="FILE"),
    threshold=typer.Option(min=0, metavar="STD"),
)
def dark(
    plan: Plan,
    output: Path | str,
    threshold: float = THRESHOLD,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
) -> DarkMeasurement:
    """Measure dark counts and hot pixels in a capture that was recorded with the lens covered, and write them.

    Corrections that move pixels are applied before, so list the file after them in a spec.

    Args:
        plan: of the capture; corrections that move pixels are applied.
        output: an .npz file for the dark counts of each pixel, which the corrections `hot-pixels` and `dark-counts` take; or a
            .npy file for the mask of the hot pixels.
        threshold: hot pixels are above the median by this many standard deviations.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.
        overwrite: replace the file that is there under this name.

    Raises:
        InputError: all pixels are masked.
        OutputError: the file has another suffix, is there already, or cannot be written.
    """
    output = Path(output)
    if output.suffix not in (".npz", ".npy"):
        raise OutputError(f"cannot write {output}: dark counts are an .npz file, and a mask of hot pixels is a .npy file")
    require_new(output, overwrite)
    with build_source(plan) as source:
        info, valid = source.info, source.valid
        if not valid.any():
            raise InputError("dark counts cannot be measured: all pixels of the capture are masked")
        with usual(progress).stage("dark counts", info.n_frames, "frames") as advance:
            measured = measure_dark(source, advance)
    hot, limit = hot_in_the_dark(measured, threshold, valid)
    with atomic_path(output) as temporary:
        if output.suffix == ".npz":
            write_dark(temporary, measured)
        else:
            np.save(temporary, hot)
    warnings = []
    if info.kind == "binary" and np.median(measured.rates[valid]) > BRIGHT:
        warnings.append(f"half of the pixels count more than {BRIGHT:g} photons per frame; was the lens covered?")
    uses = {"hot-pixels": "dark", "dark-counts": "dark"} if output.suffix == ".npz" else {"mask": "file"}
    corrections = [*written_corrections(plan.corrections), *({name: {key: str(output)}} for name, key in uses.items())]
    return DarkMeasurement(
        path=output,
        info=info,
        rates=measured.rates,
        valid=valid,
        hot=hot & valid,
        limit=limit,
        corrections=corrections,
        warnings=tuple(warnings),
    )
