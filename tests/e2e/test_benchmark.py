"""The benchmark: captures that are drawn from a seed, and entries from any program."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from photonpano import InputError, OutputError, load_trajectory, parse_spec, run
from photonpano.api.benchmark.captures import ALL, PUBLIC, Benchmark, capture_plan
from photonpano.api.benchmark.make import make
from photonpano.api.benchmark.score import score
from photonpano.evaluation import load_truth


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


@pytest.mark.parametrize("name", ["turn", "loop", "lens", "sealed-flicker", "sealed-super-resolution", "sealed-trembling"])
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
    with pytest.raises(InputError, match=r"has no benchmark\.json; give the folder that `photonpano benchmark make` wrote"):
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
