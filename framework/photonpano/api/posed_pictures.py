"""Make pictures of a finished run with the poses of their camera, for programs that reconstruct scenes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from photonpano.api.opened_run import OpenedRun, opened_run
from photonpano.capture import with_background
from photonpano.errors import InputError
from photonpano.evaluation import load_run_poses
from photonpano.execution.threads import thread_count
from photonpano.files.folders import require_new
from photonpano.geometry import Camera, canvas_of_box, nearest_rotations, outline_of
from photonpano.pipeline.film import Film
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import capture_files, require_one_run
from photonpano.record.picture_files import Picture
from photonpano.record.poses import Poses, read_colmap
from photonpano.values import FloatArray

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
    every: int,
    bits: Literal[8, 16],
    capture: Path | str | None,
    catalog: Catalog | None,
    *,
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
            Camera(camera.matrix) if undistorted else camera,
            motion.frame_shape,
            tuple(f"exposure_{span.start:0{digits}}.png" for span in spans),
            nearest_rotations(camera.rotations(motion.trajectory.at(instants))),
            instants / (rate or 1.0),
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
    view = (opened.motion, canvas, settings.tolerance_px, 0.0, recorded["white_flux"], settings.white_balance)
    return Film(source, *view)


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
