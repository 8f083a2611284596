"""Make a video along the motion of a finished run."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import typer

from photonpano.api.command import command
from photonpano.api.opened_run import OpenedRun, opened_run
from photonpano.api.render import require_harmless, require_same_plane
from photonpano.capture import with_background
from photonpano.corrections.moments import showing
from photonpano.errors import InputError
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import require_new
from photonpano.geometry import canvas_of_box
from photonpano.merging.accumulate import bytes_of_light
from photonpano.merging.colour import channels_of
from photonpano.merging.panorama import BYTES_PER_PIXEL, box_of, plan_canvas
from photonpano.motion.frame_motion import view_of
from photonpano.pipeline.film import Film, merged
from photonpano.pipeline.rendering import naming_key_of_canvas
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import capture_files
from photonpano.record.picture_files import advancing, require_writable, write_pictures
from photonpano.text import byte_size, counted
from photonpano.values import FrameSpan

View = Literal["panorama", "smooth"]
_SMOOTH_S = 0.5  # standard deviation of the smooth path, in seconds of the video
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


@dataclass(frozen=True, slots=True)
class Video:
    """A video, written by `video`.

    Attributes:
        path: the file, or the folder of pictures.
        n_pictures: how many pictures it holds.
        shape: (height, width) of a picture.
        exposure: frames that a picture merges.
        step: frames from one picture to the next.
        speed: seconds of the capture that pass in a second of the video; None if the capture has no frame rate.
    """

    path: Path
    n_pictures: int
    shape: tuple[int, int]
    exposure: int
    step: float
    speed: float | None


def _lines(made: Video) -> Iterator[str]:
    height, width = made.shape
    yield f"{made.path}: {counted(made.n_pictures, 'picture')} of {height}x{width}, {made.exposure:,} frames each"
    if made.speed is not None:
        yield f"a second of the video shows {made.speed:.4g} s of the capture"


@command(
    "runs/first first.mp4 --view smooth --exposure 2ms --speed 0.05",
    _lines,
    settings={"scale": typer.Option(metavar="X", help="Pixels of the video per pixel of a frame.")},
    output=typer.Argument(metavar="OUT"),
    view=typer.Option(metavar="VIEW", parser=str),
    exposure=typer.Option(metavar="N|TIME"),
    fps=typer.Option(min=0.1, max=240, metavar="HZ"),
    speed=typer.Option(metavar="X"),
)
def video(
    run_folder: Path | str,
    output: Path | str,
    *,
    view: View = "panorama",
    exposure: int | str | None = None,
    fps: float = 25,
    speed: float | None = None,
    trail: bool = False,
    changes: Sequence[str] = (),
    overwrite: bool = False,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
) -> Video:
    """Make a video along the motion of a finished run. Nothing is located again.

    Each picture merges the frames of an exposure along the motion, in the view of its middle. The flux that is white in the
    panorama of the run is white in all pictures. MP4 needs av: pip install "photonpano[video]".

    Args:
        run_folder: written by `run`.
        output: an .mp4, .webp or .gif file, or a folder for PNGs of 16 bits.
        view: "panorama", the canvas of the panorama, on which still things stand still; or "smooth", as large as a frame, which
            follows the camera without its tremor.
        exposure: frames that a picture merges, or a time such as "5 ms"; by default as many as the groups of the last level.
        fps: pictures per second of the video.
        speed: seconds of the capture that pass in a second of the video; below 1 for slow motion. By default, each picture
            begins where the exposure of the one before ends.
        trail: draw the outline of the frame, over the panorama.
        changes: values of the recorded spec to change, such as `render.scale=0.5` or `render.extent=reference`.
        overwrite: replace the video that is there under this name.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        CanvasTooLargeError: the panorama would exceed `run.memory`.
        InputError: the folder is no run folder, its capture cannot be opened, or is another capture now; or an argument is
            wrong.
        OutputError: the video is there already, or cannot be written, or the library that writes it is missing.
        SpecError: a change is wrong.
    """
    for change in changes:
        require_harmless(change)
    if view not in ("panorama", "smooth"):
        raise InputError(f"view: expected panorama or smooth, got {view}")
    for name, value in (("fps", fps), ("speed", speed)):
        if value is not None and not 0 < value < np.inf:
            raise InputError(f"{name}: expected a number above 0, got {value:g}")
    if trail and view == "smooth":
        raise InputError("the trail is drawn over the panorama; choose the view panorama, or no trail")
    output, progress = Path(output), usual(progress)
    with opened_run(Path(run_folder), catalog, changes) as opened, one_thread_inside():
        require_new(output, overwrite, [opened.folder, *capture_files(opened.plan)])
        require_same_plane(opened)
        n_frames, step = _timing(opened, exposure, fps, speed)
        located = opened.motion.span
        number = int((len(located) - n_frames) / step + 1e-9) + 1
        starts = [located.start + round(place * step) for place in range(number)]
        spans = [FrameSpan(start, start + n_frames) for start in starts if start + n_frames <= located.stop]
        require_writable(output, len(spans))
        film = _film(opened, view, trail, _SMOOTH_S * fps * step)
        threads = thread_count(opened.plan.run.threads)
        names = [f"frame_{number:0{len(str(len(spans)))}}" for number in range(len(spans))]
        with progress.stage(f"writing {output.name}", len(spans), "pictures") as advance:
            write_pictures(output, advancing(film.pictures(spans, threads, 8 if output.suffix else 16), advance), names, fps)
        rate = opened.source.info.frame_rate_hz
        return Video(output, len(spans), film.canvas.shape, n_frames, step, None if rate is None else step * fps / rate)


def _timing(opened: OpenedRun, exposure: int | str | None, fps: float, speed: float | None) -> tuple[int, float]:
    """Return the frames of an exposure, and from one exposure to the next."""
    rate = opened.source.info.frame_rate_hz
    if speed is not None and rate is None:
        raise InputError(
            f"{opened.folder}: the speed of a video needs the frame rate of the capture, which is not known; "
            "set source.with.frame_rate_hz, or leave the speed out"
        )
    n_frames = round(opened.record["levels"][-1]["group_frames"]) if exposure is None else _frames(str(exposure), rate)
    located = len(opened.motion.span)
    if n_frames > located:
        raise InputError(
            f"{opened.folder}: an exposure of {n_frames:,} frames is longer than the {located:,} frames that were located; "
            "choose a shorter one"
        )
    return n_frames, float(n_frames) if speed is None or rate is None else speed * rate / fps


def _frames(exposure: str, rate: float | None) -> int:
    """Return the number of frames of an exposure."""
    match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(s|ms|us)?\s*", exposure)
    if match is None or (match[2] is None and not match[1].isdigit()):
        raise InputError(f"exposure: expected a number of frames, or a time such as 5ms, got {exposure}")
    if match[2] is not None and rate is None:
        raise InputError("exposure: the frame rate of the capture is not known; give a number of frames")
    n_frames = int(match[1]) if match[2] is None else round(float(match[1]) * _UNITS[match[2]] * (rate or 0))
    if n_frames < 1:
        raise InputError(f"exposure: expected at least one frame, got {exposure}")
    return n_frames


def _film(opened: OpenedRun, view: View, trail: bool, smooth_frames: float) -> Film:
    plan, motion, recorded = opened.plan, opened.motion, opened.record["panorama"]
    memory = int(plan.run.memory)
    source = with_background(opened.source, None)  # what moves is shown, wherever it is
    if recorded is None:
        raise InputError(f"{opened.folder}: the run made no panorama, and a video is as bright as that")
    if view == "panorama":
        shown = motion.trajectory, motion.span, motion.frame_shape
        seen = view_of(motion, opened.source, plan.render.projection, level=plan.render.horizon == "level")
        with naming_key_of_canvas(plan):
            canvas = plan_canvas(*shown, plan.render.scale, memory, extent=plan.render.extent, view=seen)
    else:  # as large as a frame, or as a part of it
        extent = "reference" if plan.render.extent == "panorama" else plan.render.extent
        canvas = canvas_of_box(box_of(extent, motion.frame_shape), plan.render.scale)
    bytes_per_pixel = (BYTES_PER_PIXEL + bytes_of_light(source)) * channels_of(source)
    if (needed := canvas.height * canvas.width * bytes_per_pixel) > memory:
        raise InputError(
            f"{opened.folder}: a picture of {canvas.height}x{canvas.width} px takes {byte_size(needed)}, more than the "
            f"{byte_size(memory)} of run.memory; lower render.scale, or choose a part with render.extent"
        )
    tolerance_px = plan.render.tolerance_px
    still, *_ = showing(opened.source, motion.trajectory, motion.camera, plan.render.movers)
    brighter = plan.render.exposure_stops - opened.record["spec"]["render"]["exposure_stops"]
    return Film(
        source,
        motion,
        canvas,
        tolerance_px,
        smooth_frames if view == "smooth" else None,
        recorded["white_flux"] / 2**brighter,
        plan.render.white_balance,
        merged(still, motion, motion.span, canvas, tolerance_px, thread_count(plan.run.threads)) if trail else None,
    )
