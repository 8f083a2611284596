"""Render frames along a motion: a finished run with other settings, its video, and frames for those who want nothing else."""

from __future__ import annotations

import datetime
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from photonpano.api.command import command
from photonpano.api.run_folders import OpenedRun, load_trajectory, opened_run
from photonpano.capture import with_background
from photonpano.corrections.movers import showing
from photonpano.errors import InputError
from photonpano.execution.context import Context, Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import require_new
from photonpano.geometry import canvas_of_box, inverse
from photonpano.merging.accumulate import bytes_of_light
from photonpano.merging.colour import channels_of
from photonpano.merging.panorama import BYTES_PER_PIXEL, RenderedPanorama, box_of, plan_canvas
from photonpano.motion.frame_motion import view_of
from photonpano.pipeline.film import Film, merged
from photonpano.pipeline.rendering import naming_key_of_canvas, render_into, write_halves
from photonpano.pipeline.run_folder import run_folder as writing_run_folder
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import capture_files, fingerprint
from photonpano.record.picture_files import advancing, require_writable, write_pictures
from photonpano.record.run_json import (
    decision_records,
    detail_record,
    library_versions,
    panorama_record,
    peak_memory_bytes,
    plugin_records,
)
from photonpano.record.schema import RunRecord
from photonpano.report.notebook import run_html
from photonpano.text import byte_size, counted
from photonpano.values import Decision, FloatArray, FrameSpan

if TYPE_CHECKING:
    from photonpano.evaluation import RunTrajectory

# Sections of a spec that may differ from those of the run. That of the source tells where the capture is now.
_SECTIONS = ("render", "output", "run", "source")
View = Literal["panorama", "smooth"]
_SMOOTH_S = 0.5  # standard deviation of the smooth path, in seconds of the video
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


@dataclass(frozen=True, slots=True)
class RenderResult:
    """A run that was rendered again."""

    directory: Path  # the new run folder
    record: RunRecord = field(repr=False)  # the content of its `run.json`

    def _repr_html_(self) -> str:
        return run_html(self.directory, self.record)


@command(
    "runs/first --scale 2 --output runs/large",
    lambda result: [f"panorama  {result.directory.resolve() / 'panorama.png'}"],
    settings={
        "scale": typer.Option(metavar="X", help="Pixels of the panorama per pixel of a frame."),
        "projection": typer.Option(
            metavar="NAME",
            help="planar, cylindrical, spherical, mercator, panini, stereographic, or auto; other than planar for a camera "
            "that only rotates.",
        ),
        "extent": typer.Option(
            metavar="BOX",
            help="panorama, reference (a stabilised image), or a box x0,y0,x1,y1: in pixels of the reference frame, but in "
            "degrees on a cylinder or a sphere.",
        ),
    },
)
def render(
    run_folder: Path | str,
    output: Path | str,
    changes: Sequence[str] = (),
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
) -> RenderResult:
    """Render the panorama of a finished run again, with other settings. Nothing is located again.

    The new folder is a run folder without a report. Its files are, byte for byte, those of a whole run with these settings.

    Args:
        run_folder: written by `run`.
        output: the new run folder.
        changes: values of the recorded spec to change, such as `render.scale=2`, `output.formats=[exr]`, or
            `source.with.path=...` for a capture that was moved.
        overwrite: write beside other files, which stay, or replace a run of another capture.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        CanvasTooLargeError: the panorama would exceed `run.memory`.
        InputError: the folder is no run folder, its capture cannot be opened, or it is another capture now; `output` is
            that folder.
        OutputError: the new folder cannot be written.
        PluginError: the renderer or an exporter failed, or broke its contract.
        SpecError: a change is wrong.
    """
    for change in changes:
        require_harmless(change)
    if any(_key(change) == "render.use" for change in changes):
        changes = ["render.with={}", *changes]  # the recorded keys are those of another renderer
    start, folder = time.perf_counter(), Path(run_folder)
    if Path(output).absolute().resolve() == folder.absolute().resolve():
        raise InputError(f"{folder} would be replaced by its own rendering; choose another folder with --output")
    with (
        opened_run(folder, catalog, changes, Path(output)) as opened,
        writing_run_folder(
            opened.plan.output.directory, overwrite=overwrite, inputs=[folder, *capture_files(opened.plan)]
        ) as written,
        one_thread_inside(),
    ):
        require_same_plane(opened)
        context = Context(threads=thread_count(opened.plan.run.threads), progress=usual(progress))
        rendered = render_into(
            written, opened.plan, opened.source, vignette=opened.vignette, motion=opened.motion, context=context
        )
        record = _record(opened, *rendered, time.perf_counter() - start)
        if opened.plan.output.keep == "halves":
            canvas = rendered[0].canvas
            halves = write_halves(written, opened.plan, opened.source, motion=opened.motion, canvas=canvas, context=context)
            record["detail"] = detail_record(halves)
        record = written.commit(record)
    return RenderResult(opened.plan.output.directory, record)


def require_harmless(change: str) -> None:
    """Refuse a change of what a rendering does not do."""
    if _key(change).partition(".")[0] not in _SECTIONS:
        raise InputError(
            f"{change}: a rendering has only the sections {', '.join(_SECTIONS[:-1])} and {_SECTIONS[-1]}; "
            "run the spec again to change others"
        )


def _key(change: str) -> str:
    return change.partition("=")[0].strip()


def require_same_plane(opened: OpenedRun) -> None:
    """Refuse another reference frame than that of the run."""
    recorded, wanted = opened.record["spec"]["render"]["reference"], opened.plan.render.reference
    if recorded != wanted:
        raise InputError(
            f"render.reference: the panorama of {opened.folder} lies in the plane of frame {recorded!r}, and a rendering stays "
            f"there; run the spec again for {wanted!r}"
        )


def _record(opened: OpenedRun, panorama: RenderedPanorama, chosen: Sequence[Decision], seconds: float) -> RunRecord:
    """Return the record of the run, with what was rendered again."""
    plan, old = opened.plan, opened.record
    # The last decisions are those of renderer and exporters.
    before = [] if old["panorama"] is None else old["panorama"].get("decisions", [])
    kept = old["decisions"][: len(old["decisions"]) - len(before)]
    return {
        **old,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "spec": plan.document,
        "plugins": plugin_records(plan),
        "libraries": library_versions(plan),
        "decisions": [*kept, *decision_records(chosen)],
        "findings": {**old.get("findings", {}), "never_seen_share": panorama.never_seen_share},
        "panorama": panorama_record(plan, panorama, chosen),
        "seconds": round(seconds, 3),
        "peak_memory_bytes": peak_memory_bytes(),
        "capture": fingerprint(plan, opened.capture),
        "rendered_from": str(opened.folder.absolute()),
    }


@dataclass(frozen=True, slots=True)
class Video:
    """A video, written by `video`."""

    path: Path  # the file, or the folder of pictures
    n_pictures: int  # how many pictures it holds
    shape: tuple[int, int]  # (height, width) of a picture
    exposure: int  # frames that a picture merges
    step: float  # frames from one picture to the next
    speed: float | None  # seconds of the capture that pass in a second of the video; None if the capture has no frame rate


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
def video(  # noqa: PLR0913
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
        source=source,
        motion=motion,
        canvas=canvas,
        tolerance_px=tolerance_px,
        smooth_frames=smooth_frames if view == "smooth" else None,
        white_flux=recorded["white_flux"] / 2**brighter,
        white_balance=plan.render.white_balance,
        panorama=merged(
            still, motion, motion.span, canvas=canvas, tolerance_px=tolerance_px, threads=thread_count(plan.run.threads)
        )
        if trail
        else None,
    )


def warp(frames: Any, trajectory: RunTrajectory | NDArray[np.floating[Any]] | Path | str) -> Any:
    """Warp frames to the pixels of the reference frame, interpolated linearly: a stabilised film.

    To sum photons, take the panorama of a run: it interpolates once, where sums of warped frames blur.

    Args:
        frames: (T, H, W) or (T, H, W, C), numbers or flags; an array of numpy, or a tensor of torch.
        trajectory: the motion of these T frames: what `load_trajectory` returns, a run folder, or homographies (T, 3, 3) from
            pixels of a frame to pixels of the reference frame. That of a run knows the lens.

    Returns:
        float32 of the shape of the frames, NaN where a frame does not show a pixel. Of a tensor, a tensor on the same device,
        which can be differentiated by the frames.

    Raises:
        InputError: frames and motion do not belong together.
    """
    motion = load_trajectory(trajectory) if isinstance(trajectory, str | Path) else trajectory
    homographies = np.asarray(getattr(motion, "homographies", motion), np.float64)
    camera = getattr(motion, "camera", None)
    shape = tuple(frames.shape)
    if len(shape) not in (3, 4) or homographies.shape != (shape[0], 3, 3):
        raise InputError(
            f"warp takes frames (T, H, W) or (T, H, W, C) and a homography for each, (T, 3, 3); got the shapes {shape} and "
            f"{homographies.shape}. Give the frames of the whole run, or the homographies of a part of them"
        )
    known = getattr(motion, "frame_shape", shape[1:3])
    if tuple(known) != shape[1:3]:
        raise InputError(f"the motion is of frames of {known[0]}x{known[1]} px, and these have {shape[1]}x{shape[2]}")
    y, x = np.mgrid[: shape[1], : shape[2]].astype(np.float64)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    on_tensors = not isinstance(frames, np.ndarray)
    warped = []
    for frame, to_frame in zip(frames, inverse(homographies), strict=True):
        rays = pixels @ to_frame.T
        with np.errstate(divide="ignore", invalid="ignore"):
            places = np.where(rays[..., 2:] > 0, rays[..., :2] / rays[..., 2:], np.nan)
        if camera is not None and camera.distorts:
            places = camera.distorted(places)
        warped.append(_sampled_tensor(frame, places) if on_tensors else _sampled(frame, places))
    if not on_tensors:
        return np.stack(warped) if warped else np.zeros(shape, np.float32)
    import torch

    return torch.stack(warped) if warped else torch.zeros(shape)


def _seen(places: FloatArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    x, y = places[..., 0], places[..., 1]
    return np.asarray((x >= 0) & (y >= 0) & (x <= shape[1] - 1) & (y <= shape[0] - 1))


def _sampled(frame: NDArray[Any], places: FloatArray) -> NDArray[np.float32]:
    x, y = np.moveaxis(np.nan_to_num(places, nan=-1).astype(np.float32), -1, 0)
    image = cv2.remap(frame.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = _seen(places, frame.shape).reshape(places.shape[:2] + (1,) * (frame.ndim - 2))
    return np.asarray(np.where(seen, image.reshape(frame.shape), np.nan), np.float32)


def _sampled_tensor(frame: Any, places: FloatArray) -> Any:
    import torch
    from torch.nn.functional import grid_sample

    image = frame.float().reshape(*frame.shape[:2], -1).movedim(-1, 0)
    size = np.array([max(frame.shape[1] - 1, 1), max(frame.shape[0] - 1, 1)])
    grid = torch.as_tensor(2 * np.nan_to_num(places, nan=-1) / size - 1, dtype=torch.float32, device=frame.device)
    sampled = grid_sample(image[None], grid[None], padding_mode="border", align_corners=True)[0].movedim(0, -1)
    seen = torch.as_tensor(_seen(places, tuple(frame.shape)), device=frame.device)
    return torch.where(seen[..., None], sampled, torch.nan).reshape(frame.shape)
