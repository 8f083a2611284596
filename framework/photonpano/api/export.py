"""Write poses of a camera for other programs, and pictures with them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import typer

from photonpano.api.command import command
from photonpano.api.posed_pictures import pictures_of_poses, pictures_of_turn
from photonpano.errors import InputError
from photonpano.evaluation import RunPoses, RunTrajectory, has_poses, load_run_poses, load_run_trajectory
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import one_thread_inside
from photonpano.files.folders import atomic_folder, require_new
from photonpano.geometry import positions_of
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import require_one_run
from photonpano.record.picture_files import Picture, advancing, write_pngs
from photonpano.record.poses import POSE_FORMATS, PoseFormat, Poses, ply
from photonpano.record.run_json import read_record
from photonpano.text import counted


@dataclass(frozen=True, slots=True)
class ExportedPoses:
    """Poses that were written.

    Attributes:
        files: their paths.
        n_frames: frames, or pictures, with a pose.
        pictures: the folder of the pictures; None without them.
    """

    files: tuple[Path, ...]
    n_frames: int
    pictures: Path | None = None


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
def export(
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
        file_format: "colmap" (a text model), "nerfstudio" (transforms.json), "openmvg" (sfm_data.json) or "tum" (times and
            quaternions).
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
        raise InputError("the format tum has no pictures; leave out --images, or choose colmap, nerfstudio or openmvg")
    if not images and (bits != 8 or undistorted or capture is not None):
        raise InputError("--bits, --undistorted and --capture are about pictures; add --images")
    folder, output = Path(run_folder), Path(output)
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
            made = pictures_of_turn(folder, output, every, bits, capture, catalog, undistorted=undistorted)
            poses, pictures = stack.enter_context(made)
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
    return Poses(camera, run.frame_shape, names, rotations[frames], frames / (rate or 1.0), places)
