"""Write poses of a camera for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from photonpano.api.command import command
from photonpano.errors import InputError
from photonpano.evaluation import RunPoses, RunTrajectory, has_poses, load_run_poses, load_run_trajectory
from photonpano.files.folders import atomic_folder, require_new
from photonpano.record.contents import require_one_run
from photonpano.record.poses import POSE_FORMATS, PoseFormat, Poses, centres
from photonpano.record.run_json import read_record


@dataclass(frozen=True, slots=True)
class ExportedPoses:
    """Poses that were written.

    Attributes:
        files: their paths.
        n_frames: frames with a pose.
    """

    files: tuple[Path, ...]
    n_frames: int


@command(
    "runs/turn --format colmap --output poses",
    lambda found: [f"{found.n_frames:,} poses in {', '.join(map(str, found.files))}"],
    file_format=typer.Option("--format"),
    every=typer.Option(min=1, metavar="N"),
    frame_rate_hz=typer.Option("--frame-rate", min=1e-6, metavar="HZ"),
)
def export(
    run_folder: Path | str,
    file_format: PoseFormat,
    output: Path | str,
    every: int = 1,
    *,
    frame_rate_hz: float | None = None,
    overwrite: bool = False,
) -> ExportedPoses:
    """Write the poses and the camera of a run for another program.

    Needs a run with the model rotation, or with pose. Frames that were not located are left out.

    Args:
        run_folder: written by `run`, with the model `rotation` or with `pose`.
        file_format: "colmap" (a text model), "nerfstudio" (transforms.json) or "tum" (times and quaternions).
        output: the folder of the files.
        every: 1 for all located frames, 2 for every other, and so on.
        frame_rate_hz: for the times of "tum", in Hz; by default that of the capture.
        overwrite: replace the poses that are there under this name.

    Raises:
        InputError: the folder is no run folder, the run knows no rotations, or no frame is located; for "tum", the frame rate
            is not known.
        OutputError: the folder is there already, or cannot be written.
        ValueError: the format is not known, `every` is below 1, or `frame_rate_hz` is not above 0.
    """
    if file_format not in POSE_FORMATS or every < 1:
        raise ValueError(
            f"file_format must be one of {', '.join(POSE_FORMATS)}, and every at least 1; got {file_format!r} and {every}"
        )
    if frame_rate_hz is not None and not 0 < frame_rate_hz < np.inf:
        raise ValueError(f"frame_rate_hz must be above 0, got {frame_rate_hz:g}")
    folder, output = Path(run_folder), Path(output)
    require_new(output, overwrite, [folder])
    files = POSE_FORMATS[file_format](poses := _poses(folder, every, frame_rate_hz, needs_seconds=file_format == "tum"))
    with atomic_folder(output) as written:
        for name, text in files.items():
            (written / name).write_text(text, encoding="utf-8")
    return ExportedPoses(tuple(output / name for name in files), len(poses.names))


def _poses(folder: Path, every: int, frame_rate_hz: float | None, needs_seconds: bool) -> Poses:
    require_one_run(folder, ["trajectory.npz", "poses.npz"])
    positions = None
    run: RunPoses | RunTrajectory
    if has_poses(folder):
        run = load_run_poses(folder)
        camera, positions = run.camera, centres(run.camera_from_world)
        rotations = np.swapaxes(run.camera_from_world[:, :, :3], -1, -2)
    else:
        run = load_run_trajectory(folder, needs_std_px=False)
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
