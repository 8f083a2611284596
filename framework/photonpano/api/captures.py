"""Write captures to packed .npy files, and to the folders that sources write."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from photonpano.atomic import atomic_folder
from photonpano.captures.picture_files import counted, write_pngs
from photonpano.captures.preview import require_sharp_views, sharp_pictures
from photonpano.captures.writing import write_folder, write_packed
from photonpano.context import Progress, usual
from photonpano.contributions import SourceContribution
from photonpano.errors import OutputError
from photonpano.notebooks import facts
from photonpano.pipeline.components import build_source
from photonpano.protocols import Source
from photonpano.registry import Catalog, discover
from photonpano.specs import Plan
from photonpano.threads import one_thread_inside, thread_count
from photonpano.values import StreamInfo


@dataclass(frozen=True, slots=True)
class WrittenCapture:
    """A packed .npy file, or a folder such as a zarr array, written by `convert` or `simulate`.

    Attributes:
        path: the file or folder.
        truth: the file beside it with the true motion and scene, if the source knows them.
        info: the size and rate of the capture.
        n_masked: how many pixels the source masks; the file holds no mask.
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
        """Show what was written in a notebook."""
        files = {"capture": self.path, "truth": self.truth, "frames without noise": self.sharp}
        rows = [(name, str(path)) for name, path in files.items() if path]
        return facts([*rows, ("frames", str(self.info)), ("source", str(dict(self.source)))])


def convert(
    plan: Plan,
    output: Path | str,
    progress: Progress | None = None,
    resumed: Callable[[int], object] | None = None,
    *,
    compress: bool = False,
    catalog: Catalog | None = None,
) -> WrittenCapture:
    """Write a capture of binary frames to a packed .npy file, or to a zarr array.

    When writing a .npy file is interrupted, the frames written so far stay in OUTPUT.part. The next call compares them with the
    capture, and continues from there. A zarr array is written whole or not at all.

    Args:
        plan: of the capture, from `capture_plan` or `load_spec`; its corrections are applied.
        output: the .npy file, or a folder with a name that ends as those that a source writes, such as .zarr.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.
        resumed: called with the number of frames that OUTPUT.part holds, if there are any.
        compress: whether to compress the frames, in a format that can.
        catalog: the sources that may write it; by default those of the installed plugins.

    Raises:
        InputError: the frames are not binary, or a correction changes sums of frames, which bits cannot hold.
        OutputError: the file cannot be written, the disk is full, or OUTPUT.part is another file.
    """
    output = Path(output)
    writer = _writer_of(output, discover() if catalog is None else catalog)
    if writer is None and compress:
        raise OutputError(f"cannot compress {output}: packed .npy files are not compressed; name it {output.stem}.zarr")
    with build_source(plan) as source:
        return _write(source, plan, output, progress, resumed or (lambda _: None), writer, compress)


def simulate(
    plan: Plan, output: Path | str, progress: Progress | None = None, sharp_every: int | None = None
) -> WrittenCapture:
    """Write a capture as `convert` does, whole or not at all; a simulated one with its truth beside it.

    Args:
        plan: of the capture; its source may be any that gives binary frames.
        output: the .npy file, or the folder.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.
        sharp_every: frames from one picture without noise to the next. They are written to the folder CAPTURE.sharp, such as
            cube.sharp/frame_000050.png for cube.npy: 8 bits, sRGB, the same white in all. None writes none.

    Raises:
        InputError: as `convert`; or the source cannot show frames without noise.
        OutputError: as `convert`; or the folder of the pictures is there already.
    """
    output = Path(output)
    writer = _writer_of(output, discover())
    with build_source(plan) as source:
        if sharp_every is None:
            return _write(source, plan, output, progress, None, writer)
        sharp, views = output.with_suffix(".sharp"), require_sharp_views(source)
        frames = range(0, source.info.n_frames, sharp_every)
        with atomic_folder(sharp) as folder:
            with one_thread_inside(), usual(progress).stage(f"writing {sharp.name}", len(frames), "pictures") as advance:
                pictures = sharp_pictures(views, frames, thread_count(plan.run.threads))
                write_pngs(folder, counted(pictures, advance), [f"frame_{frame:06}" for frame in frames])
            return replace(_write(source, plan, output, progress, None, writer), sharp=sharp)


def _writer_of(output: Path, catalog: Catalog) -> SourceContribution | None:
    """Return the source that writes a folder of such a name; None for any other name."""
    for entry in catalog.rows:
        source = entry.contribution
        if isinstance(source, SourceContribution) and source.write and output.suffix.lower() in source.suffixes:
            return source
    return None


def _write(
    source: Source,
    plan: Plan,
    output: Path,
    progress: Progress | None,
    resumed: Callable[[int], object] | None,
    writer: SourceContribution | None = None,
    compressed: bool = False,
) -> WrittenCapture:
    info, n_masked, threads = source.info, int((~source.valid).sum()), thread_count(plan.run.threads)
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
