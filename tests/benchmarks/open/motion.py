"""Read the motion that any program has found of a capture, in the files and conventions that programs use."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from photonpano.errors import InputError
from photonpano.evaluation.inputs import RunTrajectory, Truth, frame_shape_of, load_run_trajectory, read_numbers
from photonpano.evaluation.scores import corner_errors
from photonpano.geometry import Camera, normalised, rescaling, scaled_ahead, translation
from photonpano.reading import reading
from photonpano.values import BoolArray, FloatArray, Homography

from .captures import BenchmarkCapture

_MATRIX = tuple(f"h{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
_COLUMNS = f"frame and {_MATRIX[0]} to {_MATRIX[-1]}, or frame, x and y, with angle_deg and std_px if they are known"
_TUM = "seconds, x, y, z and a quaternion x, y, z, w"
# An entry in another convention has an error above this, which the right one divides by this at least.
_WRONG_PX, _RATIO = 1.0, 3.0
_FEWEST = 20  # located frames of an entry: the alignment has as many parameters as a frame has coordinates of corners
_SCALES = (0.25, 0.5, 2.0, 4.0)  # sizes of frames that are tried, as shares of that of the capture


def read_motion(path: Path, capture: BenchmarkCapture) -> tuple[RunTrajectory, tuple[str, ...]]:
    """Read the motion of a run folder, or of an .npz, .csv or .txt (TUM) file, and notes about what was adapted.

    Frames that the file leaves out, or whose numbers are not finite, are not located; between located ones, their motion is
    interpolated for the panorama.

    Raises:
        InputError: the file is damaged, has none of these forms, or belongs to another capture.
    """
    if path.is_dir():
        motion = load_run_trajectory(path)
        if motion.frame_shape != capture.frame_shape or len(motion.located) != capture.n_frames:
            raise InputError(f"{path} is a run of {_size(len(motion.located), motion.frame_shape)}, and {_expected(capture)}")
        _require_enough(path, motion.located)
        return motion, ()
    read = {".npz": _from_archive, ".csv": _from_table, ".txt": _from_tum}[path.suffix]
    homographies, located, std_px, camera, notes = read(path, capture)
    _require_enough(path, located)
    if missing := capture.n_frames - int(located.sum()):
        notes = (*notes, f"{missing:,} frames are missing")
    frames = np.arange(capture.n_frames)
    flat = homographies.reshape(-1, 9)
    filled = np.stack([np.interp(frames, frames[located], column[located]) for column in flat.T], axis=1).reshape(-1, 3, 3)
    return RunTrajectory(filled, np.eye(3), capture.frame_shape, located, std_px, camera), notes


_Read = tuple[FloatArray, BoolArray, FloatArray, Camera | None, tuple[str, ...]]


def _from_archive(path: Path, capture: BenchmarkCapture) -> _Read:
    content = "the motion of an entry, `homographies` (frames, 3, 3)"
    arrays = read_numbers(path, content, (), ("homographies", "located", "std_px", "frame_shape"))
    found = arrays.get("homographies")
    if found is None or found.ndim != 3 or found.shape[1:] != (3, 3):
        shape = "none" if found is None else f"the shape {found.shape}"
        raise InputError(f"{path} must hold `homographies` of the shape ({capture.n_frames}, 3, 3), got {shape}")
    if len(found) != capture.n_frames:
        raise InputError(
            f"{path} has {len(found):,} homographies, and {_expected(capture)}: give one for each frame, or a .csv file"
        )
    located = arrays.get("located", np.ones(len(found))).astype(bool)
    std_px = arrays.get("std_px", np.full(len(found), np.nan)).astype(np.float64)
    if not located.shape == std_px.shape == (len(found),):
        raise InputError(f"{path}: located and std_px must have a value for each of {len(found):,} frames")
    located &= np.isfinite(found).all(axis=(1, 2))
    homographies, notes = _safe(found.astype(np.float64), located, path), tuple[str, ...]()
    height, width = frame_shape_of(path, arrays) if "frame_shape" in arrays else capture.frame_shape
    true_height, true_width = capture.frame_shape
    if (height, width) != capture.frame_shape:
        if abs(height / true_height - width / true_width) > 1 / min(height, width):
            raise InputError(f"{path} is of frames of {height}x{width}, and {_expected(capture)}")
        homographies = homographies @ rescaling(width / true_width)
        notes = (f"made of frames of {height}x{width}, and converted",)
    return homographies, located, std_px, None, notes


def _from_table(path: Path, capture: BenchmarkCapture) -> _Read:
    with reading(path, "is not a table; separate its columns by commas"), path.open(newline="", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    names = set(rows[0]) if rows else set()
    matrices = {"frame", *_MATRIX} <= names
    if not matrices and not {"frame", "x", "y"} <= names:
        got = ", ".join(sorted(filter(None, names))) or "nothing"
        raise InputError(f"{path}: the first line must name the columns {_COLUMNS}; got {got}")
    homographies, std_px = np.full((capture.n_frames, 3, 3), np.nan), np.full(capture.n_frames, np.nan)
    for line, row in enumerate(rows, start=2):
        try:
            frame = int(row["frame"])
            if matrices:
                matrix = np.array([float(row[name]) for name in _MATRIX]).reshape(3, 3)
            else:
                matrix = _moved(float(row["x"]), float(row["y"]), float(row.get("angle_deg") or 0), capture.frame_shape)
            std = float(row.get("std_px") or "nan")
        except (TypeError, ValueError):
            raise InputError(f"{path}: line {line} is not {_COLUMNS}: {dict(row)}") from None
        if not 0 <= frame < capture.n_frames:
            raise InputError(f"{path}: line {line} is of frame {frame}, and {_expected(capture)}, counted from 0")
        if np.isfinite(std_px[frame]) or np.isfinite(homographies[frame]).any():
            raise InputError(f"{path}: line {line} is of frame {frame} again; give one line for each frame")
        homographies[frame], std_px[frame] = matrix, std
    located = np.isfinite(homographies).all(axis=(1, 2))
    return _safe(homographies, located, path), located, std_px, None, ()


def _from_tum(path: Path, capture: BenchmarkCapture) -> _Read:
    with reading(path, f"is not a trajectory as TUM writes it: lines of {_TUM}"):
        table = np.loadtxt(path, ndmin=2)
        if table.shape[1] != 8:
            raise ValueError(table.shape)
    frames = np.rint(table[:, 0] * capture.frame_rate_hz).astype(int)
    if frames.min() < 0 or frames.max() >= capture.n_frames or len(np.unique(frames)) != len(frames):
        raise InputError(
            f"{path}: times of {table[0, 0]:g} to {table[-1, 0]:g} s are frames {frames.min()} to {frames.max()} at "
            f"{capture.frame_rate_hz:,g} Hz, and {_expected(capture)}: count seconds from the first frame"
        )
    from scipy.spatial.transform import Rotation

    camera = Camera.of(capture.focal_px, capture.frame_shape)
    homographies = np.full((capture.n_frames, 3, 3), np.nan)
    with reading(path, "has a quaternion without length"):
        homographies[frames] = camera.matrix @ Rotation.from_quat(table[:, 4:]).as_matrix() @ np.linalg.inv(camera.matrix)
    notes = ("a camera that only turns; positions are not used",) if np.ptp(table[:, 1:4], axis=0).max() > 0 else ()
    return homographies, np.isfinite(homographies).all(axis=(1, 2)), np.full(capture.n_frames, np.nan), camera, notes


def in_true_plane(motion: RunTrajectory, truth: Truth) -> tuple[RunTrajectory, tuple[str, ...]]:
    """Return the motion in the plane of the truth, by the convention that fits it, with a note if that is another than ours.

    Ours: homographies map pixels (x, y) of a frame, integers at their centres, to those of any plane, which is aligned. Only if
    an entry is far off, and another convention brings it much nearer, is that taken.
    """
    if truth.around or motion.camera is not None:
        return motion, ()

    to_frame = np.linalg.inv(truth.homographies[len(truth.homographies) // 2])

    def aligned(homographies: FloatArray) -> tuple[float, FloatArray]:
        """Return the error, and the motion in the plane of the truth, in px of the middle frame."""
        try:
            found = corner_errors(homographies, truth.homographies, truth.frame_shape, motion.located)
        except (ValueError, np.linalg.LinAlgError):
            return np.inf, homographies
        return found.mean_px, scaled_ahead(to_frame @ found.alignment @ homographies)

    notes = tuple[str, ...]()
    usual, homographies = aligned(motion.homographies)
    if usual > _WRONG_PX:
        others = {name: aligned(each) for name, each in _conventions(motion)}
        name = min(others, key=lambda each: others[each][0])
        if others[name][0] * _RATIO < usual:
            notes = (f"{name}: scored as such, otherwise {usual:.1f} px",)
            homographies = others[name][1]
    return replace(motion, homographies=homographies), notes


def _conventions(motion: RunTrajectory) -> Iterator[tuple[str, FloatArray]]:
    height, width = motion.frame_shape
    homographies = motion.homographies
    yield "maps the plane to frames", np.asarray(np.linalg.inv(homographies), np.float64)
    for name, mirror in (("x", np.diag([-1.0, 1, 1])), ("y", np.diag([1.0, -1, 1]))):
        middle = translation((width - 1) / 2, (height - 1) / 2)
        yield f"{name} is mirrored", homographies @ middle @ mirror @ np.linalg.inv(middle)
    yield "x and y are exchanged", homographies @ np.eye(3)[[1, 0, 2]]
    for scale in _SCALES:
        yield f"made of frames {scale:g} times as large", homographies @ rescaling(scale)


def _moved(x: float, y: float, angle_deg: float, frame_shape: tuple[int, int]) -> Homography:
    """Return the map of a frame that is turned about its middle, and shifted."""
    middle = translation((frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2)
    cosine, sine = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    return np.asarray(translation(x, y) @ middle @ turn @ np.linalg.inv(middle))


def _safe(homographies: FloatArray, located: BoolArray, path: Path) -> FloatArray:
    try:
        homographies[located] = normalised(homographies[located])
        np.linalg.inv(homographies[located])
    except (ValueError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path}: homographies must be invertible") from error
    return homographies


def _require_enough(path: Path, located: BoolArray) -> None:
    if located.sum() < _FEWEST:
        raise InputError(
            f"{path}: {located.sum()} frames are located; give {_FEWEST} or more, since fewer fit any truth once aligned"
        )


def _size(n_frames: int, frame_shape: tuple[int, int]) -> str:
    return f"{n_frames:,} frames of {frame_shape[0]}x{frame_shape[1]}"


def _expected(capture: BenchmarkCapture) -> str:
    return f"the capture has {_size(capture.n_frames, capture.frame_shape)}"
