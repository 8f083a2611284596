"""Motion and pictures of other programs: their files, their conventions, and what is wrong in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from photonpano import InputError
from photonpano.evaluation import Truth, corner_errors
from photonpano.evaluation.entries import Expected, in_true_plane, read_motion
from photonpano.geometry import normalised, rescaling, translation

SHAPE, N_FRAMES = (60, 90), 40
CAPTURE = Expected(N_FRAMES, SHAPE, 1000.0, 300.0)
MATRIX = "h11,h12,h13,h21,h22,h23,h31,h32,h33"
MIRROR_X = np.array([[-1.0, 0, SHAPE[1] - 1], [0, 1, 0], [0, 0, 1]])
MIRROR_Y = np.array([[1.0, 0, 0], [0, -1, SHAPE[0] - 1], [0, 0, 1]])
EXCHANGE = np.eye(3)[[1, 0, 2]]
HALF = rescaling(0.5)


@pytest.fixture(scope="module")
def motion() -> np.ndarray:
    """A camera that pans, rolls and has perspective: frame pixels to those of a scene."""
    times = np.linspace(0, 1, N_FRAMES)
    shifts = [translation(80 + 60 * t, 50 + 9 * np.sin(5 * t)) for t in times]
    turns = [np.array([[np.cos(t / 4), -np.sin(t / 4), 0], [np.sin(t / 4), np.cos(t / 4), 0], [2e-4 * t, 0, 1]]) for t in times]
    return normalised(np.array(shifts) @ np.array(turns))


@pytest.fixture(scope="module")
def truth(motion: np.ndarray) -> Truth:
    return Truth(motion, SHAPE, None, motion)


def error_of(path: Path, truth: Truth) -> tuple[float, float, tuple[str, ...]]:
    """Return mean error and located share of an entry as it is scored, and all notes."""
    found, notes = read_motion(path, CAPTURE)
    found, adapted = in_true_plane(found, truth)
    score = corner_errors(found.homographies, truth.homographies, SHAPE, found.located)
    return score.mean_px, score.located_share, (*notes, *adapted)


def write_table(path: Path, homographies: np.ndarray, frames: list[int]) -> None:
    rows = [",".join(map(str, [frame, *homographies[frame].ravel()])) for frame in frames]
    path.write_text("\n".join([f"frame,{MATRIX}", *rows]))


def test_table_may_leave_frames_out(tmp_path: Path, motion: np.ndarray, truth: Truth) -> None:
    write_table(tmp_path / "a.csv", motion, list(range(0, N_FRAMES, 2)))
    error, share, notes = error_of(tmp_path / "a.csv", truth)
    assert error < 1e-3
    assert share == 0.5
    assert notes == ("20 frames are missing",)


def test_table_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    rows = [f"{frame},{frame},0" for frame in range(N_FRAMES)]
    (tmp_path / "a.csv").write_text("\n".join(["frame,x,y", *rows]), encoding="utf-8-sig")  # as Excel writes it
    assert read_motion(tmp_path / "a.csv", CAPTURE)[0].located.all()


def test_table_of_shifts_and_angles_turns_frames_about_their_middle(tmp_path: Path) -> None:
    angles = np.linspace(0, 30, N_FRAMES)
    rows = [f"{frame},{3 * frame},{-frame},{angle},0.25" for frame, angle in enumerate(angles)]
    (tmp_path / "a.csv").write_text("\n".join(["frame,x,y,angle_deg,std_px", *rows]))
    found, _ = read_motion(tmp_path / "a.csv", CAPTURE)
    middle, moved = (np.array([(SHAPE[1] - 1) / 2 + x, (SHAPE[0] - 1) / 2 + y, 1]) for x, y in ((0, 0), (30, -10)))
    np.testing.assert_allclose(found.homographies[10] @ middle, moved, atol=1e-9)
    assert np.rad2deg(np.arctan2(*found.homographies[10, [1, 0], 0])) == pytest.approx(angles[10])
    assert (found.std_px == 0.25).all()


def test_quaternions_become_homographies_of_the_camera(tmp_path: Path) -> None:
    rotations = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.05, 0.3, 0.1], N_FRAMES))
    lines = np.column_stack([np.arange(N_FRAMES) / 1000, np.zeros((N_FRAMES, 3)), rotations.as_quat()])
    np.savetxt(tmp_path / "a.txt", lines)
    found, notes = read_motion(tmp_path / "a.txt", CAPTURE)
    assert found.turn is not None
    np.testing.assert_allclose(found.turn.rotations, rotations.as_matrix(), atol=1e-9)
    assert notes == ()


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (lambda h: translation(7, -3) @ rescaling(3) @ h, ""),
        (lambda h: np.linalg.inv(h), "maps the plane to frames"),
        (lambda h: MIRROR_X @ h @ MIRROR_X, "x is mirrored"),
        (lambda h: MIRROR_Y @ h @ MIRROR_Y, "y is mirrored"),
        (lambda h: EXCHANGE @ h @ EXCHANGE, "x and y are exchanged"),
        (lambda h: HALF @ h @ np.linalg.inv(HALF), "made of frames 0.5 times as large"),
    ],
)
def test_other_convention_is_said_and_scored(
    change: Callable[[np.ndarray], np.ndarray], note: str, tmp_path: Path, motion: np.ndarray, truth: Truth
) -> None:
    np.savez(tmp_path / "a.npz", homographies=change(motion))
    error, share, notes = error_of(tmp_path / "a.npz", truth)
    assert error < 1e-3
    assert share == 1
    assert [each.partition(":")[0] for each in notes] == [note] * bool(note)


def test_size_of_frames_is_converted_and_poor_motion_stays_poor(tmp_path: Path, motion: np.ndarray, truth: Truth) -> None:
    np.savez(tmp_path / "a.npz", homographies=HALF @ motion @ np.linalg.inv(HALF), frame_shape=(30, 45))
    error, _, notes = error_of(tmp_path / "a.npz", truth)
    assert error < 1e-3
    assert notes == ("made of frames of 30x45, and converted",)
    shaken = translation(0, 0) @ motion
    shaken[:, :2, 2] += np.random.default_rng(0).normal(0, 4, (N_FRAMES, 2))
    np.savez(tmp_path / "a.npz", homographies=shaken)
    error, _, notes = error_of(tmp_path / "a.npz", truth)
    assert error > 2
    assert notes == ()


def text_of(lines: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(lines)


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        (
            "a.csv",
            text_of("t,x\n0,1\n"),
            "the first line must name the columns frame and h11 to h33, or frame, x and y, .*; got t, x",
        ),
        ("a.csv", text_of("frame,x,y\n0,1,\n"), "line 2 is not frame and h11"),
        (
            "a.csv",
            text_of("frame,x,y\n40,1,2\n"),
            "line 2 is of frame 40, and the capture has 40 frames of 60x90, counted from 0",
        ),
        ("a.csv", text_of(f"frame,{MATRIX}\n0{',0' * 9}\n"), "homographies must be invertible"),
        ("a.csv", text_of("frame,x,y\n0,nan,nan\n"), "0 frames are located; give 20 or more"),
        ("a.csv", text_of("frame,x,y\n0,1,2\n0,1,2\n"), "line 3 is of frame 0 again"),
        ("a.txt", text_of("0 0 0 0 0 0 1\n"), "is not a trajectory as TUM writes it"),
        ("a.txt", text_of("0.05 0 0 0 0 0 0 1\n"), "are frames 50 to 50 at 1,000 Hz, .*: count seconds from the first frame"),
        (
            "a.npz",
            lambda path: np.savez(path, motion=np.eye(3)),
            r"must hold `homographies` of the shape \(40, 3, 3\), got none",
        ),
        (
            "a.npz",
            lambda path: np.savez(path, homographies=np.stack([np.eye(3)] * 39)),
            "has 39 homographies, and the capture has 40",
        ),
        (
            "a.npz",
            lambda path: np.savez(path, homographies=np.stack([np.eye(3)] * 40), frame_shape=(30, 30)),
            "is of frames of 30x30, and the capture has 40 frames of 60x90",
        ),
        (
            "a.npz",
            lambda path: np.savez(path, homographies=np.stack([np.eye(3)] * 40), frame_shape=(40, 60, 90)),
            r"frame_shape must be two positive integers \(height, width\), got \[40, 60, 90\]",
        ),
        (
            "a.npz",
            lambda path: np.savez(path, homographies=np.stack([np.eye(3)] * 40), std_px=["unknown"] * 40),
            "std_px must contain numbers",
        ),
        (
            "a.npz",
            lambda path: np.savez(path, homographies=np.stack([np.eye(3)] * 40), located=np.ones((40, 1), bool)),
            "located and std_px must have a value for each of 40 frames",
        ),
    ],
)
def test_wrong_entry_is_named(name: str, write: Callable[[Path], object], message: str, tmp_path: Path) -> None:
    write(tmp_path / name)
    with pytest.raises(InputError, match=message):
        read_motion(tmp_path / name, CAPTURE)
