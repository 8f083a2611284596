"""What refiners, renderers, exporters and pose estimators may return or write."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np

from photonpano.contracts.rules import (
    STRICT_IMAGES,
    Contract,
    Rule,
    float64,
    has_h33_of_1,
    images,
    instance,
    is_float64,
    is_real,
    not_float64,
    shown,
    text,
)
from photonpano.geometry import Canvas
from photonpano.values import BoolArray, FloatArray, Panorama, PosedView, PoseEstimate, Reason, Refined, StreamInfo

_ORTHONORMAL = 1e-6  # largest element of R R^T - I of a rotation


def _real(name: str) -> Rule:
    return (
        f"{name} are arrays of float64, got {{}}",
        lambda found, _: not is_real(getattr(found, name)) and (shown(getattr(found, name)),),
    )


def _other_frames(found: Refined, std_px: FloatArray) -> object:
    n, shapes = len(std_px), (found.homographies.shape, found.std_px.shape)
    return shapes != ((n, 3, 3), (n,)) and (n, n, n, *shapes)


def _lost(found: Refined, _: FloatArray) -> object:
    bad = ~np.isfinite(found.homographies).all(axis=(1, 2)) | np.isnan(found.std_px) | (found.std_px < 0)
    return bad.any() and (int(np.argmax(bad)),)


def _singular(found: Refined, _: FloatArray) -> object:
    with np.errstate(all="ignore"):
        bad = ~(np.abs(np.linalg.det(found.homographies)) > 0) | (found.homographies[:, 2, 2] == 0)
    return bad.any() and (first := int(np.argmax(bad)), found.homographies[first].tolist())


def _lost_elsewhere(found: Refined, std_px: FloatArray) -> object:
    other = np.isfinite(found.std_px) != np.isfinite(std_px)
    return other.any() and (first := int(np.argmax(other)), std_px[first], found.std_px[first])


# Facts: (T,) the expected errors of the motion that the refiner was given.
REFINED: Contract[Refined] = Contract(
    [
        instance("a Refined or None", Refined),
        _real("homographies"),
        _real("std_px"),
        text("summary", "the summary"),
        (
            "the capture has {} frames: expected homographies of the shape ({}, 3, 3) and std_px of the shape ({},), got {} "
            "and {}",
            _other_frames,
        ),
        ("the motion of frame {} is not finite, or its std_px is negative or NaN", _lost),
        ("a homography is invertible and has h33 = 1, that of frame {} is {}", _singular),
        ("std_px is infinite exactly where it was before; that of frame {} was {:g}, and is {:g}", _lost_elsewhere),
    ],
    strict=[
        is_float64("homographies"),
        has_h33_of_1(lambda found: found.homographies),
        (
            "the summary must be one line that says what was corrected, got {!r}",
            lambda found, _: (not found.summary or found.summary != " ".join(found.summary.split())) and (found.summary,),
        ),
    ],
)

# Facts: the canvas that the renderer was given.
PANORAMA: Contract[Panorama] = Contract(
    [
        instance("a Panorama", Panorama),
        *images(lambda canvas: canvas.shape),
        (
            "the canvas of the panorama is the transform of the given canvas, got another one",
            lambda found, canvas: not np.array_equal(np.asarray(found.canvas), canvas.transform),
        ),
    ],
    strict=STRICT_IMAGES,
)


def require_panorama(found: object, canvas: Canvas) -> Panorama:
    """Return what a renderer returned for a canvas, in float32, or raise `BrokenContract`."""
    panorama = PANORAMA.require(found, canvas)
    flux, weight = (np.ascontiguousarray(image, np.float32) for image in (panorama.flux, panorama.weight))
    return Panorama(flux, weight, canvas.transform)


def _no_content(_: Collection[str], path: Path) -> object:
    files = [path] if path.is_file() else [*path.rglob("*")]
    return not any(each.is_file() and not each.is_symlink() and each.stat().st_size for each in files) and (path.name,)


# The names of the files and folders that an exporter wrote. Facts: the path that it was given.
FILES: Contract[Collection[str]] = Contract(
    [
        (
            "expected {} alone, got {} as well",
            lambda written, path: (others := sorted({*written} - {path.name})) and (path.name, ", ".join(others)),
        ),
        ("expected a file or folder {} with content, got none", _no_content),
    ]
)


def _are_rigid(poses: FloatArray) -> BoolArray:
    """Return which poses (N, 3, 4) are finite and made of a rotation and a translation: (N,)."""
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    rotations = np.where(finite[:, None, None], poses[:, :, :3], 0)
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(1, 2))
    rigid: BoolArray = finite & (off < _ORTHONORMAL) & (np.linalg.det(rotations) > 0)
    return rigid


def _no_flags(found: PoseEstimate, stream: StreamInfo) -> object:
    located = np.asarray(found.located)
    wrong = located.shape != (stream.n_frames,) or located.dtype != np.bool_
    return wrong and (stream.n_frames, shown(found.located))


def _not_rigid(found: PoseEstimate, _: StreamInfo) -> object:
    located = np.asarray(found.located)
    wrong = np.flatnonzero(located)[~_are_rigid(found.camera_from_world[located])]
    return wrong.size and (wrong[0],)


def _std(name: str) -> tuple[Rule, Rule]:
    def wrong(found: PoseEstimate, _: StreamInfo) -> object:
        std, located = getattr(found, name), np.asarray(found.located)
        return not ((std[located] >= 0).all() and np.isnan(std[~located]).all())

    sentence = f"{name} must be 0 or more where a frame is located, inf if not known, and NaN elsewhere"
    return float64(name, lambda _, stream: (stream.n_frames,)), (sentence, wrong)


def _no_camera(found: PoseEstimate, _: StreamInfo) -> object:
    matrix = found.camera_matrix
    right = np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0 and matrix[2].tolist() == [0, 0, 1]
    return not right and (matrix.tolist(),)


def _no_points(found: PoseEstimate, _: StreamInfo) -> object:
    positions, count = found.points.positions, len(found.points.positions)
    right = not not_float64(positions, (count, 3)) and np.isfinite(positions).all()
    return not (right and np.shape(found.points.flux) == (count,)) and (count,)


def _no_reason(found: PoseEstimate, _: StreamInfo) -> object:
    given: tuple[object, ...] = found.doubts
    return next(((shown(each),) for each in given if not isinstance(each, Reason)), None)


def _unexplained(found: PoseEstimate, _: StreamInfo) -> object:
    known = np.array(found.located)
    for each in found.lost:
        known[each.span.start : each.span.stop] = True
    return not known.all() and (int(np.argmin(known)),)


def _elsewhere(found: PoseEstimate, stream: StreamInfo) -> object:
    for view in found.views:
        if view.span.stop > stream.n_frames or not view.span.start <= view.instant <= view.span.stop - 1:
            return view.span, view.instant
    return None


def _no_indices(view: PosedView, count: int) -> tuple[object, ...]:
    indices = np.asarray(view.points)
    whole = indices.ndim == 1 and indices.dtype.kind in "iu"
    right = whole and (not indices.size or 0 <= indices.min() <= indices.max() < count)
    return () if right else (count - 1, shown(view.points))


def _of_views(sentence: str, check: Callable[[PosedView, int], object]) -> Rule:
    """Require something of every view, whose span comes first in the sentence; `check` takes the number of points as well."""

    def wrong(found: PoseEstimate, _: StreamInfo) -> object:
        for view in found.views:
            if rest := check(view, len(found.points.positions)):
                return view.span, *(rest if isinstance(rest, tuple) else ())
        return None

    return sentence, wrong


# Facts: the stream of the capture.
POSES: Contract[PoseEstimate] = Contract(
    [
        ("expected a PoseEstimate, got {}", lambda found, _: not isinstance(found, PoseEstimate) and (shown(found),)),
        ("expected located as {} flags, got {}", _no_flags),
        ("no frame is located; raise a LocationError with the reason instead", lambda found, _: not np.any(found.located)),
        float64("camera_from_world", lambda _, stream: (stream.n_frames, 3, 4)),
        (
            "camera_from_world must be NaN where a frame is not located",
            lambda found, _: not np.isnan(found.camera_from_world[~np.asarray(found.located)]).all(),
        ),
        ("the pose of frame {} must be a finite rotation and translation", _not_rigid),
        *_std("std_position"),
        *_std("std_rotation_deg"),
        float64("camera_matrix", lambda *_: (3, 3)),
        ("camera_matrix must be finite with positive focal lengths, got {}", _no_camera),
        float64("distortion", lambda *_: (4,)),
        (
            "distortion must be finite, and std_focal_px 0 or more",
            lambda found, _: not (np.isfinite(found.distortion).all() and found.std_focal_px >= 0),
        ),
        ("expected finite positions of {} points as float64, and a flux for each", _no_points),
        ("the view of {} is seen from the instant {:g}, or reaches beyond the capture", _elsewhere),
        _of_views(
            "expected the pose of the view of {} as float64 of the shape {}, got {}",
            lambda view, _: not_float64(view.camera_from_world, (3, 4)),
        ),
        _of_views(
            "the pose of the view of {} must be a finite rotation and translation",
            lambda view, _: not _are_rigid(view.camera_from_world[None]).all(),
        ),
        _of_views("the view of {} must show points 0 to {}, got {}", _no_indices),
        _of_views(
            "expected xy of the view of {} as float64 of the shape {}, got {}",
            lambda view, _: not_float64(view.xy, (len(view.points), 2)),
        ),
        _of_views("xy of the view of {} must be finite", lambda view, _: not np.isfinite(view.xy).all()),
        ("frame {} is not located, and no entry of lost says why", _unexplained),
        ("expected each of the doubts as a Reason, got {}", _no_reason),
    ]
)
