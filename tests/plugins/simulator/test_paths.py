from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import InputError
from photonpano.geometry import corners, transform_points, translation
from photonpano_simulator.config import SimulatorConfig
from photonpano_simulator.paths import camera_path

SCENE = (1365, 2048)
MIDDLE = np.array([1023.5, 682.0])
FRAME = (254, 496)
FOCAL = 4464.0

LINES: dict[str, dict[str, Any]] = {
    "pan": {"kind": "pan", "angle_deg": 30},
    "scan": {"kind": "scan", "rows": 3, "row_spacing_px": 60},
    "loop": {"kind": "loop", "aspect": 3},
    "random-spline": {"kind": "random-spline", "knots": 7, "seed": 5},
}


def homographies(path: dict[str, Any], n_frames: int = 2001, seed: int = 0, **settings: Any) -> np.ndarray:
    config = SimulatorConfig.model_validate({"path": path, "n_frames": n_frames} | settings)
    return camera_path(config, SCENE, seed)


def centres(maps: np.ndarray) -> np.ndarray:
    return transform_points(maps, [[(FRAME[1] - 1) / 2, (FRAME[0] - 1) / 2]])[:, 0]


def steps(maps: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(centres(maps), axis=0), axis=1)


@pytest.mark.parametrize("kind", LINES)
def test_path_has_the_length_of_the_config(kind: str) -> None:
    assert steps(homographies(LINES[kind] | {"length_px": 700}, 20_001)).sum() == pytest.approx(700, rel=1e-4)


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("shake", [None, {"rms_px": 3, "roll_rms_deg": 0.5}])
def test_homographies_are_rotations_of_the_camera(kind: str, shake: dict[str, Any] | None) -> None:
    maps = homographies(LINES[kind] | {"length_px": 700, "shake": shake}, 50)
    frame = np.array([[FOCAL, 0, (FRAME[1] - 1) / 2], [0, FOCAL, (FRAME[0] - 1) / 2], [0, 0, 1]])
    scene = np.array([[FOCAL, 0, MIDDLE[0]], [0, FOCAL, MIDDLE[1]], [0, 0, 1]])
    turns = np.linalg.inv(scene) @ maps @ frame
    turns /= np.cbrt(np.linalg.det(turns))[:, None, None]
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(maps[:, 2, 2], 1)


@pytest.mark.parametrize("kind", ["pan", "scan", "loop"])
def test_speed_is_constant(kind: str) -> None:
    lengths = steps(homographies(LINES[kind] | {"length_px": 700}))
    np.testing.assert_allclose(lengths, 700 / 2000, rtol=2e-3)


def test_perspective_follows_the_focal_length() -> None:
    """At the angle a from the axis, a small step of the camera covers 1 / cos(a)^2 as much of the scene."""
    maps = homographies({"kind": "pan", "length_px": 800}, 3)
    width = np.diff(transform_points(maps, [[247, 126.5], [248, 126.5]])[..., 0], axis=1)[:, 0]
    angle = np.arctan(400 / FOCAL)
    np.testing.assert_allclose(width, [1 / np.cos(angle) ** 2, 1, 1 / np.cos(angle) ** 2], rtol=1e-6)
    assert abs(transform_points(maps[2], corners(FRAME))[1, 1] - transform_points(maps[1], corners(FRAME))[1, 1]) > 0.5


def test_loop_returns_to_its_start() -> None:
    maps = homographies({"kind": "loop", "length_px": 900, "aspect": 3})
    np.testing.assert_allclose(maps[0], maps[-1], atol=1e-9)
    extent = np.ptp(centres(maps), axis=0)
    assert extent[0] / extent[1] == pytest.approx(3, rel=1e-3)


def test_scan_rows_have_the_spacing_of_the_config() -> None:
    points = centres(homographies({"kind": "scan", "rows": 3, "row_spacing_px": 60, "length_px": 900}, 9001))
    rows = MIDDLE[1] + np.array([-60, 0, 60])
    row = (900 - 2 * np.pi * 30) / 3
    for y, share in zip(rows, [row / 900] * 3, strict=True):
        # A row's share of the frames lies on it, and it spans the row.
        on_row = np.abs(points[:, 1] - y) < 1e-3
        assert on_row.mean() == pytest.approx(share, abs=0.01)
        assert np.ptp(points[on_row, 0]) == pytest.approx(row, abs=2)
    turns = points[np.abs(points[:, 0] - MIDDLE[0]) > row / 2 + 0.1]
    np.testing.assert_allclose(
        np.hypot(np.abs(turns[:, 0] - MIDDLE[0]) - row / 2, np.abs(turns[:, 1] - MIDDLE[1]) - 30), 30, atol=1e-3
    )


def test_random_spline_is_smooth_and_depends_on_its_seed() -> None:
    maps = homographies({"kind": "random-spline", "length_px": 800})
    velocity = np.diff(centres(maps), axis=0)
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.02 * steps(maps).max()
    assert steps(maps).max() < 4 * 800 / 2000
    assert (centres(homographies({"kind": "random-spline", "length_px": 800, "seed": 1})) != centres(maps)).any()
    np.testing.assert_array_equal(homographies({"kind": "random-spline", "length_px": 800}, seed=9), maps)


def test_shake_has_rms_and_frequencies_of_the_config() -> None:
    shake = {"rms_px": 2.0, "roll_rms_deg": 0.1, "frequencies_hz": (10, 40, 70)}
    maps = homographies({"kind": "hand-shake", "shake": shake}, 1000, frame_rate_hz=1000)
    moved = centres(maps) - MIDDLE
    np.testing.assert_allclose(np.sqrt((moved**2).mean(axis=0)), 2.0, rtol=1e-3)
    for axis in (0, 1):
        spectrum = np.abs(np.fft.rfft(moved[:, axis])) ** 2
        assert sorted(np.argsort(spectrum)[-3:]) == [10, 40, 70]
        assert spectrum[[10, 40, 70]].sum() > 0.999 * spectrum.sum()
    roll = np.rad2deg(np.arctan2(maps[:, 1, 0], maps[:, 0, 0]))
    assert np.sqrt((roll**2).mean()) == pytest.approx(0.1, rel=0.02)
    assert (homographies({"kind": "hand-shake", "shake": shake}, 1000, seed=1, frame_rate_hz=1000) != maps).any()


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (
            {"kind": "pan", "length_px": 1600},
            "the camera path leaves the scene of 1365x2048 px by 34.5 px at the left, 0% of the way along; "
            "shorten or move the path, or take a larger scene",
        ),
        (
            {"kind": "pan", "centre": (1023.5, 1300)},
            "the camera path leaves the scene of 1365x2048 px by 66.9 px at the bottom, 0% of the way along; "
            "shorten or move the path, or take a larger scene",
        ),
        (
            {"kind": "scan", "length_px": 300, "rows": 4, "row_spacing_px": 100},
            "the path of 300 px is too short for a scan of 4 rows 100 px apart, whose turns alone take 471 px; "
            "raise path.length_px, or lower path.rows",
        ),
    ],
    ids=["left", "bottom", "scan"],
)
def test_impossible_paths_are_refused(path: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        homographies(path)
    assert str(caught.value) == message


def saved(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_homographies_come_from_a_file(tmp_path: Path, suffix: str) -> None:
    maps = np.stack([2 * translation(100 + index, 50) for index in range(6)])
    path = tmp_path / f"path{suffix}"
    if suffix == ".npy":
        np.save(path, maps)
    else:
        np.savez(path, homographies=maps, other=np.zeros(3))
    np.testing.assert_array_equal(homographies({"kind": "file", "file": path}, 6), maps / 2)


def test_wrong_homography_files_are_refused(tmp_path: Path) -> None:
    cases = {
        "number": (np.tile(np.eye(3), (7, 1, 1)), "{path} holds 7 homographies for 5 frames; set n_frames to 7"),
        "shape": (np.zeros((5, 2, 3)), "{path} holds float64 of shape (5, 2, 3); homographies are (n_frames, 3, 3)"),
        "zeros": (np.zeros((5, 3, 3)), "{path} holds homographies that are not finite, or whose h33 is 0"),
        "objects": (
            np.full((5, 3, 3), None),
            "{path} is not a file of homographies: it is no .npy or .npz file of plain numbers",
        ),
    }
    for name, (array, message) in cases.items():
        path = saved(tmp_path / f"{name}.npy", array)
        with pytest.raises(InputError) as caught:
            homographies({"kind": "file", "file": path}, 5)
        assert str(caught.value) == message.format(path=path)
    behind = np.tile(translation(100, 100), (5, 1, 1))
    behind[:, 2, 0] = -0.01
    with pytest.raises(InputError, match="leaves the scene of 1365x2048 px by inf px"):
        homographies({"kind": "file", "file": saved(tmp_path / "behind.npy", behind)}, 5)
    path = tmp_path / "other.npz"
    np.savez(path, scene=np.zeros(3))
    with pytest.raises(InputError) as caught:
        homographies({"kind": "file", "file": path}, 5)
    assert str(caught.value) == f"{path} is an archive without an array 'homographies'"
    with pytest.raises(InputError, match=r"cannot read .*: Is a directory"):
        homographies({"kind": "file", "file": tmp_path}, 5)
