"""The open benchmark of tests/benchmarks/open: its captures, and entries from any program."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from photonpano import InputError, OutputError, load_trajectory, parse_spec, run
from photonpano.evaluation import Truth, corner_errors, load_truth
from photonpano.geometry import normalised, rescaling, translation

ROOT = Path(__file__).parents[3]
with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(ROOT / "tests" / "benchmarks")
    from open.captures import ALL, PUBLIC, Benchmark, BenchmarkCapture, capture_plan, make
    from open.motion import in_true_plane, read_motion
    from open.score import score

SHAPE, N_FRAMES = (60, 90), 40
CAPTURE = BenchmarkCapture(
    file="a.npy", n_frames=N_FRAMES, frame_shape=SHAPE, frame_rate_hz=1000, focal_px=300, filters=None, sha256=""
)
MATRIX = "h11,h12,h13,h21,h22,h23,h31,h32,h33"
MIRROR_X = np.array([[-1.0, 0, SHAPE[1] - 1], [0, 1, 0], [0, 0, 1]])
MIRROR_Y = np.array([[1.0, 0, 0], [0, -1, SHAPE[0] - 1], [0, 0, 1]])
EXCHANGE = np.eye(3)[[1, 0, 2]]
HALF = rescaling(0.5)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a public capture and a sealed one; the truth of the sealed one is in `truths` beside it."""
    folder = tmp_path_factory.mktemp("benchmark")
    (folder / "secret").write_text("a secret of more than sixteen bytes")
    make(folder / "set", ["flat", "sealed-fast"], folder / "secret", folder / "truths")
    return folder


def test_set_is_described_and_sealed(made: Path) -> None:
    files = sorted(path.name for path in (made / "set").iterdir())
    assert files == ["benchmark.json", "flat.npy", "flat.truth.npz", "sealed-fast.npy"]
    assert [path.name for path in (made / "truths").iterdir()] == ["sealed-fast.truth.npz"]
    described = Benchmark.read(made / "set").captures["flat"]
    assert np.load(made / "set" / "flat.npy", mmap_mode="r").shape == (described.n_frames, described.frame_shape[0], 24)


@pytest.mark.parametrize("name", ["turn", "sealed-flicker"])
def test_capture_depends_on_the_secret_if_it_is_sealed(name: str) -> None:
    drawn = capture_plan(name, b"some secret of a test").document
    assert (drawn == capture_plan(name, b"another secret").document) is (name in PUBLIC)


def test_halves_are_of_ten_captures() -> None:
    assert (len(PUBLIC), len(ALL)) == (10, 20)


def test_run_and_its_motion_and_its_picture_score_alike(made: Path, tmp_path: Path) -> None:
    truths = made / "set" / "flat.truth.npz", made / "truths" / "sealed-fast.truth.npz"
    path = str(made / "set" / "flat.npy")
    entry = tmp_path / "entry"
    quick = {"levels": 1, "refine": [], "light": "steady", "resample": {"with": {"group_size": 100}}}
    spec = {"version": 1, "source": {"use": "packed-npy", "with": {"path": path}}, **quick}
    run(parse_spec(spec, output=entry / "flat"))
    np.savez(entry / "sealed-fast.npz", homographies=load_truth(truths[1]).homographies)
    of_run, of_truth = score(made / "set", entry, made / "truths")
    assert of_run.error_px is not None
    assert of_run.error_px < 0.2
    assert of_run.honest_share is not None
    assert of_run.honest_share > 0.9
    assert of_truth.error_px == pytest.approx(0, abs=1e-4)
    assert of_truth.below_oracle_db == pytest.approx(0, abs=0.02)
    assert of_truth.honest_share is None

    (tmp_path / "motion").mkdir()
    motion = load_trajectory(entry / "flat")
    np.savez(tmp_path / "motion" / "flat.npz", homographies=motion.homographies, std_px=motion.std_px)
    (tmp_path / "motion" / "seconds.csv").write_text("flat,12.5\n")
    of_motion, nothing = score(made / "set", tmp_path / "motion")
    assert (of_motion.error_px, of_motion.honest_share) == pytest.approx((of_run.error_px, of_run.honest_share), abs=1e-3)
    assert (of_motion.psnr_db, of_motion.ssim) == pytest.approx((of_run.psnr_db, of_run.ssim), rel=0.01)
    assert (of_motion.seconds, nothing.note) == (12.5, "no entry")

    (tmp_path / "picture").mkdir()
    picture = cv2.imread(str(entry / "flat" / "panorama.png"))
    assert picture is not None
    cv2.imwrite(str(tmp_path / "picture" / "flat.png"), picture[:, ::-1])
    np.savez(tmp_path / "picture" / "sealed-fast.npz", homographies=np.eye(3)[None])
    of_picture, sealed = score(made / "set", tmp_path / "picture")
    assert of_picture.error_px is None
    assert of_picture.psnr_db == pytest.approx(of_run.psnr_db, abs=0.3)
    assert of_picture.note == "a panorama only, registered with the scene, mirrored"
    assert sealed.note == "its truth is sealed: send the entry"


def test_wrong_folders_are_named(made: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is there already"):
        make(made / "set")
    with pytest.raises(InputError, match="there is no capture calm; choose from flat, dark"):
        make(tmp_path / "other", ["calm"])
    with pytest.raises(InputError, match="sealed-dark: sealed captures come with a release; to make them, give their --secret"):
        make(tmp_path / "other", ["sealed-dark"])
    (tmp_path / "short").write_text("12345")
    with pytest.raises(InputError, match="holds 5 bytes, which can be guessed; give a secret of 16 bytes or more"):
        make(tmp_path / "other", ["sealed-dark"], tmp_path / "short", tmp_path / "truths")
    with pytest.raises(OutputError, match=r"sealed-fast\.truth\.npz is there already"):
        make(tmp_path / "other", ["sealed-fast"], made / "secret", made / "truths")
    with pytest.raises(InputError, match=r"has no benchmark\.json; give the folder that `make` wrote"):
        score(tmp_path, tmp_path)
    (tmp_path / "entry").mkdir()
    with pytest.raises(InputError, match=r"has nothing for any .* such as flat\.csv; there are flat, sealed-fast"):
        score(made / "set", tmp_path / "entry")
    np.savez(tmp_path / "entry" / "flat.npz", homographies=np.eye(3)[None])
    assert "has 1 homographies, and the capture has 3,000 frames" in score(made / "set", tmp_path / "entry")[0].note
    cv2.imwrite(str(tmp_path / "noise.png"), np.random.default_rng(0).integers(0, 255, (200, 300), np.uint8))
    (tmp_path / "entry" / "flat.npz").unlink()
    (tmp_path / "noise.png").rename(tmp_path / "entry" / "flat.png")
    assert "no homography maps the picture, as it is or mirrored," in score(made / "set", tmp_path / "entry")[0].note

    described = json.loads((made / "set" / "benchmark.json").read_text())
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "benchmark.json").write_text(
        json.dumps({**described, "version": 0, "photonpano": "0.1.0", "captures": []})
    )
    with pytest.raises(InputError, match=r"describes version 0 of the benchmark, made by photonpano 0\.1\.0"):
        score(tmp_path / "old", tmp_path / "entry")


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
