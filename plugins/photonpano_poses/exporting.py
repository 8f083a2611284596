"""Write poses of a camera for other programs, and pictures with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import cv2
import numpy as np
import typer

from photonpano.api.command import command
from photonpano.api.run_folders import OpenedRun, opened_run
from photonpano.capture import with_background
from photonpano.errors import InputError
from photonpano.evaluation import RunTrajectory, load_run_trajectory
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import atomic_folder, require_new
from photonpano.geometry import Camera, Canvas, canvas_of_box, nearest_rotations, outline_of, positions_of
from photonpano.pipeline.film import Film
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import capture_files, require_one_run
from photonpano.record.picture_files import Picture, advancing, write_pngs
from photonpano.record.run_json import read_record
from photonpano.text import counted
from photonpano.values import FloatArray
from photonpano_poses.files import Poses, colmap, nerfstudio, openmvg, ply, read_colmap, tum
from photonpano_poses.hugin import hugin
from photonpano_poses.scores import RunPoses, has_poses, load_run_poses

PoseFormat: TypeAlias = Literal["colmap", "nerfstudio", "openmvg", "pto", "tum"]
# Each returns the content of files by name.
POSE_FORMATS: Mapping[PoseFormat, Callable[[Poses], dict[str, str]]] = {
    "colmap": colmap,
    "nerfstudio": nerfstudio,
    "openmvg": openmvg,
    "pto": hugin,
    "tum": tum,
}
PosedPictures = tuple[Poses, Iterator[Picture]]  # pictures are (H, W) or (H, W, 3), red first


def pictures_of_poses(folder: Path, every: int, *, undistorted: bool) -> PosedPictures:
    """Return the pictures that a run with `pose` has written, with its points.

    Raises:
        InputError: the run has written none, or files are missing, damaged, or of another run.
    """
    run = load_run_poses(folder)
    poses = read_colmap(folder / "sparse", run.camera, run.frame_shape)
    paths = [folder / "images" / name for name in poses.names][::every]
    if not paths or not paths[0].exists():
        raise InputError(f"{folder} has no pictures of its exposures; run its spec again with --set output.exposures=true")
    models = [f"sparse/{name}.txt" for name in ("cameras", "images", "points3D")]
    require_one_run(folder, [*models, *(path.relative_to(folder).as_posix() for path in paths)])
    poses = replace(
        poses,
        names=poses.names[::every],
        rotations=poses.rotations[::every],
        seconds=poses.seconds[::every],
        positions=poses.places[::every],
        observed=poses.observed[::every],
    )
    pictures = map(_read, paths)
    if not undistorted or not run.camera.distorts:
        return poses, pictures
    places = run.camera.distorted(_pixels(run.frame_shape))
    observed = tuple((points, run.camera.ideal(xy)) for points, xy in poses.observed)
    poses = replace(poses, camera=Camera(run.camera.matrix), observed=observed)
    return poses, (_resampled(picture, places) for picture in pictures)


@contextmanager
def pictures_of_turn(
    folder: Path,
    output: Path,
    *,
    every: int,
    bits: Literal[8, 16],
    capture: Path | str | None,
    catalog: Catalog | None,
    undistorted: bool,
) -> Iterator[PosedPictures]:
    """Merge groups of frames side by side, as long as those of the last level, as the camera sees them in their middle.

    Raises:
        InputError: the motion is no rotation, or the capture cannot be opened or is another one now.
        OutputError: the capture lies in the folder `output`, whose pictures are replaced.
    """
    with opened_run(folder, catalog, moved=capture) as opened:
        require_new(output, True, capture_files(opened.plan))
        motion, rate, camera = opened.motion, opened.source.info.frame_rate_hz, opened.motion.camera
        assert camera is not None
        group_frames = round(opened.record["levels"][-1]["group_frames"])
        spans = [span for span in motion.span.blocks(group_frames) if len(span) == group_frames][::every]
        instants = np.array([span.centre for span in spans])
        digits = len(str(len(motion.located) - 1))
        poses = Poses(
            camera=Camera(camera.matrix) if undistorted else camera,
            frame_shape=motion.frame_shape,
            names=tuple(f"exposure_{span.start:0{digits}}.png" for span in spans),
            rotations=nearest_rotations(camera.rotations(motion.trajectory.at(instants))),
            seconds=instants / (rate or 1.0),
        )
        (height, width), left, top = motion.frame_shape, 0, 0
        box = (0, 0, width, height)
        if poses.camera.distorts:  # what the lens brings into the frame
            seen = camera.ideal(outline_of(motion.frame_shape, 1.0))
            left, top = np.floor(np.nanmin(seen, axis=0)).astype(int).tolist()
            right, bottom = np.ceil(np.nanmax(seen, axis=0)).astype(int).tolist()
            box = (left, top, right + 1, bottom + 1)
        pictures = _film(opened, box).pictures(spans, thread_count(opened.plan.run.threads), bits)
        if poses.camera.distorts:
            places = camera.ideal(_pixels(motion.frame_shape)) - (left, top)
            pictures = (_resampled(picture, places) for picture in pictures)
        yield poses, pictures


def _film(opened: OpenedRun, box: tuple[int, int, int, int]) -> Film:
    """Return what makes pictures of a box in ideal pixels of a frame, as bright as the panorama."""
    settings, recorded = opened.plan.render, opened.record["panorama"]
    if recorded is None:
        raise InputError(f"{opened.folder}: the run made no panorama, and the pictures are as bright as that")
    source, canvas = with_background(opened.source, None), canvas_of_box(box, 1.0)  # what moves is shown, wherever it is
    # A path that is smoothed over no frames is that of the camera.
    return Film(
        source=source,
        motion=opened.motion,
        canvas=canvas,
        tolerance_px=settings.tolerance_px,
        smooth_frames=0.0,
        white_flux=recorded["white_flux"],
        white_balance=settings.white_balance,
    )


def _pixels(shape: tuple[int, int]) -> FloatArray:
    y, x = np.indices(shape, dtype=float)
    return np.stack([x, y], axis=-1)


def _resampled(picture: Picture, places: FloatArray) -> Picture:
    """Return the picture at (H, W, 2) places, black where there is none."""
    x, y = np.nan_to_num(places, nan=-9.0).astype(np.float32).transpose(2, 0, 1)
    resampled = cv2.remap(picture, x, y, cv2.INTER_CUBIC)
    return np.asarray(resampled, np.uint8) if picture.dtype == np.uint8 else np.asarray(resampled, np.uint16)


def _read(path: Path) -> Picture:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{path} is no picture; run the spec again")
    return np.asarray(picture if picture.ndim == 2 else picture[..., ::-1], np.uint8)


@dataclass(frozen=True, slots=True)
class ExportedPoses:
    """Poses that were written."""

    files: tuple[Path, ...]  # their paths
    n_frames: int  # frames, or pictures, with a pose
    pictures: Path | None = None  # the folder of the pictures; None without them


def _lines(found: ExportedPoses) -> Iterator[str]:
    yield f"{found.n_frames:,} poses in {', '.join(map(str, found.files))}"
    if found.pictures is not None:
        yield f"{counted(found.n_frames, 'picture')} in {found.pictures}"


@command(
    "runs/turn --format colmap --images --output scene",
    _lines,
    file_format=typer.Option("--format"),
    every=typer.Option(min=1, metavar="N"),
    bits=typer.Option(metavar="8|16", parser=int),
    frame_rate_hz=typer.Option("--frame-rate", min=1e-6, metavar="HZ"),
)
def export(  # noqa: PLR0913
    run_folder: Path | str,
    file_format: PoseFormat,
    output: Path | str,
    every: int = 1,
    *,
    frame_rate_hz: float | None = None,
    images: bool = False,
    bits: Literal[8, 16] = 8,
    undistorted: bool = False,
    capture: Path | str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
) -> ExportedPoses:
    """Write the poses and the camera of a run for another program, and pictures with them.

    Needs a run with the model rotation, or with pose. Frames that were not located are left out.

    Args:
        run_folder: written by `run`, with the model `rotation` or with `pose`.
        file_format: "colmap" (a text model), "nerfstudio" (transforms.json), "openmvg" (sfm_data.json), "pto" (a project of
            Hugin, with images) or "tum" (times and quaternions).
        output: the folder of the files.
        every: 1 for all located frames, or pictures; 2 for every other, and so on.
        frame_rate_hz: for the times of "tum", in Hz; by default that of the capture.
        images: the poses are those of pictures, which are written into images/: groups of frames, as long as those of the last
            level, merged along the motion; of a run with `pose`, the pictures that it has written with `output.exposures`.
        bits: of a value of the pictures, 8 or 16, in sRGB.
        undistorted: pictures without the distortion of the lens.
        capture: the capture, if it is not where the run has read it: a file, a folder, or a URL.
        overwrite: replace the poses that are there under this name.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        InputError: the folder is no run folder, the run knows no rotations, or no frame is located; for "tum", the frame rate
            is not known; pictures cannot be made, such as of a capture that is another one now.
        OutputError: the folder is there already, or cannot be written.
        ValueError: the format is not known, `every` is below 1, or `frame_rate_hz` is not above 0.
    """
    if file_format not in POSE_FORMATS or every < 1:
        raise ValueError(
            f"file_format must be one of {', '.join(POSE_FORMATS)}, and every at least 1; got {file_format!r} and {every}"
        )
    if frame_rate_hz is not None and not 0 < frame_rate_hz < np.inf:
        raise ValueError(f"frame_rate_hz must be above 0, got {frame_rate_hz:g}")
    if bits not in (8, 16):
        raise InputError(f"bits: expected 8 or 16, got {bits}")
    if images and file_format == "tum":
        raise InputError("the format tum has no pictures; leave out --images, or choose colmap, nerfstudio, openmvg or pto")
    if not images and (bits != 8 or undistorted or capture is not None):
        raise InputError("--bits, --undistorted and --capture are about pictures; add --images")
    folder, output = Path(run_folder), Path(output)
    if file_format == "pto" and not images:
        raise InputError("a project of Hugin is one of pictures, from which it makes a panorama; add --images")
    if file_format == "pto" and has_poses(folder):
        raise InputError(
            f"{folder} is of a camera that travels, and Hugin knows cameras that only turn; choose another --format"
        )
    require_new(output, overwrite, [folder])
    poses = _poses(folder, every, frame_rate_hz, needs_seconds=file_format == "tum")
    with ExitStack() as stack:
        pictures: Iterator[Picture] = iter(())
        if images and has_poses(folder):
            if bits != 8 or capture is not None:
                raise InputError(
                    f"{folder}: the pictures of a run with pose are those that it has written, with 8 bits; leave out --bits "
                    "and --capture"
                )
            poses, pictures = pictures_of_poses(folder, every, undistorted=undistorted)
        elif images:
            stack.enter_context(one_thread_inside())
            made = pictures_of_turn(
                folder, output, every=every, bits=bits, capture=capture, catalog=catalog, undistorted=undistorted
            )
            poses, pictures = stack.enter_context(made)
        if file_format == "pto":
            poses = replace(poses, canvas=_canvas(folder))
        files = {name: text.encode() for name, text in POSE_FORMATS[file_format](poses).items()}
        if images and file_format == "colmap":
            files = {f"sparse/0/{name}": text for name, text in files.items()}
        if file_format == "nerfstudio" and poses.points is not None:
            files["points.ply"] = ply(poses.points)
        written = stack.enter_context(atomic_folder(output))
        for name, content in files.items():
            (written / name).parent.mkdir(parents=True, exist_ok=True)
            (written / name).write_bytes(content)
        if images:
            (written / "images").mkdir()
            advance = stack.enter_context(usual(progress).stage("writing pictures", len(poses.names), "pictures"))
            write_pngs(written / "images", advancing(pictures, advance), [Path(name).stem for name in poses.names])
    paths = tuple(output / name for name in files)
    return ExportedPoses(paths, len(poses.names), output / "images" if images else None)


def _canvas(folder: Path) -> Canvas:
    """Return the pixel grid of the panorama of a run, which has one."""
    panorama = read_record(folder)["panorama"]
    assert panorama is not None
    return load_run_trajectory(folder).canvas_of((panorama["height"], panorama["width"]))


def _poses(folder: Path, every: int, frame_rate_hz: float | None, needs_seconds: bool) -> Poses:
    require_one_run(folder, ["trajectory.npz", "poses.npz"])
    positions = None
    run: RunPoses | RunTrajectory
    if has_poses(folder):
        run = load_run_poses(folder)
        camera, positions = run.camera, positions_of(run.camera_from_world)
        rotations = np.swapaxes(run.camera_from_world[:, :, :3], -1, -2)
    else:
        run = load_run_trajectory(folder)
        if run.turn is None:
            raise InputError(
                f"{folder} knows homographies, and no rotations of a camera; run its spec again with "
                "--set motion.model=rotation"
            )
        camera, rotations = run.turn.camera, run.turn.rotations
    frames = np.flatnonzero(run.located)[::every]
    if not len(frames):
        raise InputError(f"{folder}: the run located no frame, so that it has no poses")
    rate = frame_rate_hz or read_record(folder)["source"]["frame_rate_hz"]
    if rate is None and needs_seconds:
        raise InputError(f"{folder} knows no frame rate, which the times of the format tum need; give it with --frame-rate")
    digits = len(str(len(run.located) - 1))
    names = tuple(f"frame_{frame:0{digits}}.png" for frame in frames.tolist())
    places = None if positions is None else positions[frames]
    return Poses(
        camera=camera,
        frame_shape=run.frame_shape,
        names=names,
        rotations=rotations[frames],
        seconds=frames / (rate or 1.0),
        positions=places,
    )
