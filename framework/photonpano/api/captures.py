"""Write captures to packed .npy files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from photonpano.atomic import atomic_folder
from photonpano.captures.picture_files import counted, write_pngs
from photonpano.captures.sharp import require_sharp_views, sharp_pictures
from photonpano.captures.writing import write_packed
from photonpano.context import Progress, Quiet
from photonpano.pipeline.components import build_source
from photonpano.protocols import Source
from photonpano.specs import Plan
from photonpano.threads import one_thread_inside, thread_count
from photonpano.values import StreamInfo


@dataclass(frozen=True, slots=True)
class WrittenCapture:
    """A packed .npy file, written by `convert` or `simulate`.

    Attributes:
        path: the file.
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


def convert(
    plan: Plan, output: Path | str, progress: Progress | None = None, resumed: Callable[[int], object] | None = None
) -> WrittenCapture:
    """Write a capture of binary frames to a packed .npy file.

    When it is interrupted, the frames written so far stay in OUTPUT.part. The next call compares them with the capture,
    and continues from there.

    Args:
        plan: of the capture, from `capture_plan` or `load_spec`; its corrections are applied.
        output: the .npy file.
        progress: receives the stage; quiet by default.
        resumed: called with the number of frames that OUTPUT.part holds, if there are any.

    Raises:
        InputError: the frames are not binary, or a correction changes sums of frames, which bits cannot hold.
        OutputError: the file cannot be written, the disk is full, or OUTPUT.part is another file.
    """
    with build_source(plan) as source:
        return _write(source, plan, Path(output), progress, resumed or (lambda _: None))


def simulate(
    plan: Plan, output: Path | str, progress: Progress | None = None, sharp_every: int | None = None
) -> WrittenCapture:
    """Write a capture to a packed .npy file, whole or not at all; a simulated one with its truth beside it.

    Args:
        plan: of the capture; its source may be any that gives binary frames.
        output: the .npy file.
        progress: receives the stage; quiet by default.
        sharp_every: frames from one picture without noise to the next. They are written to the folder CAPTURE.sharp, such as
            cube.sharp/frame_000050.png for cube.npy: 8 bits, sRGB, the same white in all. None writes none.

    Raises:
        InputError: as `convert`; or the source cannot show frames without noise.
        OutputError: as `convert`; or the folder of the pictures is there already.
    """
    output = Path(output)
    with build_source(plan) as source:
        if sharp_every is None:
            return _write(source, plan, output, progress, None)
        sharp, views = output.with_suffix(".sharp"), require_sharp_views(source)
        frames = range(0, source.info.n_frames, sharp_every)
        with atomic_folder(sharp) as folder:
            with one_thread_inside(), (progress or Quiet()).stage(f"writing {sharp.name}", len(frames), "pictures") as advance:
                pictures = sharp_pictures(views, frames, thread_count(plan.run.threads))
                write_pngs(folder, counted(pictures, advance), [f"frame_{frame:06}" for frame in frames])
            return replace(_write(source, plan, output, progress, None), sharp=sharp)


def _write(
    source: Source, plan: Plan, output: Path, progress: Progress | None, resumed: Callable[[int], object] | None
) -> WrittenCapture:
    info, n_masked = source.info, int((~source.valid).sum())
    with (progress or Quiet()).stage(f"writing {output.name}", info.n_frames, "frames") as advance:
        path, *truth = write_packed(source, output, advance, thread_count(plan.run.threads), resumed)
    keys: dict[str, Any] = {"path": str(path)}
    if info.frame_rate_hz is not None:
        keys["frame_rate_hz"] = info.frame_rate_hz
    if info.width % 8:
        keys["width"] = info.width
    return WrittenCapture(path, truth[0] if truth else None, info, n_masked, {"use": "packed-npy", "with": keys})
