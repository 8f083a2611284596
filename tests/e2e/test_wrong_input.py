"""Wrong input on the command line: message, exit code, and no files left."""

from __future__ import annotations

import re
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from photonpano.cli.app import app

SPEC = """\
version: 1
source:
  use: packed-npy
  with: {path: cube.npy}
resample: {with: {group_size: 10}}
"""
FRAMES = np.random.default_rng(0).random((40, 32, 48)) < 0.4
PACKED = np.packbits(FRAMES, axis=-1)
BLANK_WALL = np.packbits(np.random.default_rng(0).random((40, 128, 160)) < 0.4, axis=-1)

ONE_PROBLEM = "error: the spec has 1 problem\n"
DIMENSIONS = "a packed capture has 3 dimensions, frames, height and bytes of a row, and one of colour a fourth, of 3 channels\n"


def saved(array: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / "cube.npy", array)


def nothing(folder: Path) -> None: ...


def truncated(folder: Path) -> None:
    np.save(folder / "cube.npy", PACKED)
    whole = (folder / "cube.npy").read_bytes()
    (folder / "cube.npy").write_bytes(whole[:-100])


def a_photograph(folder: Path) -> None:
    (folder / "cube.npy").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))


def with_a_file_in_the_way(folder: Path) -> None:
    np.save(folder / "cube.npy", PACKED)
    (folder / "runs").write_text("not a folder")


@dataclass(frozen=True)
class Case:
    """Wrong input.

    Attributes:
        arrange: writes the capture into a folder.
        code: the exit code.
        golden: the text on stderr; DIR is the folder, # is any number.
        change: a text of the spec and its replacement.
    """

    arrange: Callable[[Path], None]
    code: int
    golden: str
    change: tuple[str, str] = ("", "")


CASES = {
    "missing": Case(
        nothing,
        2,
        "DIR/spec.yaml:2:1: source: there is no file DIR/cube.npy; check the path\n" + ONE_PROBLEM,
    ),
    "truncated": Case(
        truncated,
        2,
        "DIR/spec.yaml:2:1: source: DIR/cube.npy is cut short: its header (40, 32, 6) promises 7808 bytes, "
        "the file has 7708; copy or record it again\n" + ONE_PROBLEM,
    ),
    "another format": Case(
        a_photograph,
        2,
        "DIR/spec.yaml:2:1: source: DIR/cube.npy is not a .npy file, by its first bytes; write it with numpy.save\n"
        + ONE_PROBLEM,
    ),
    "wrong dtype": Case(
        saved(FRAMES),
        2,
        "DIR/spec.yaml:2:1: source: DIR/cube.npy holds bool values, not bytes of eight pixels; "
        "write source: {use: npy, with: {path: DIR/cube.npy, holds: bits}}\n" + ONE_PROBLEM,
    ),
    "too few dimensions": Case(
        saved(PACKED[0]),
        2,
        "DIR/spec.yaml:2:1: source: DIR/cube.npy has the shape (32, 6); " + DIMENSIONS + ONE_PROBLEM,
    ),
    "too many dimensions": Case(
        saved(PACKED[..., None]),
        2,
        "DIR/spec.yaml:2:1: source: DIR/cube.npy has the shape (40, 32, 6, 1); " + DIMENSIONS + ONE_PROBLEM,
    ),
    "width of other rows": Case(
        saved(PACKED),
        2,
        "DIR/spec.yaml:2:1: source: DIR/cube.npy has rows of 6 bytes, which hold a width of 41 to 48, not 50; "
        "correct the width\n" + ONE_PROBLEM,
        ("cube.npy}", "cube.npy, width: 50}"),
    ),
    "not packed": Case(
        saved(FRAMES.astype(np.uint8)),
        2,
        "DIR/spec.yaml:2:1: source: DIR/cube.npy has rows of 48 bytes, which hold a width of 377 to 384, not 48; "
        "it seems not to be packed: write source: {use: npy, with: {path: DIR/cube.npy, holds: bits}}\n" + ONE_PROBLEM,
        ("cube.npy}", "cube.npy, width: 48}"),
    ),
    "fewer frames than a group": Case(
        saved(PACKED),
        2,
        "DIR/spec.yaml:5:1: resample: the capture has 40 frames, fewer than one group of 100; "
        "set group_size to 10 or less, so that at least four groups fit\n" + ONE_PROBLEM,
        ("group_size: 10", "group_size: 100"),
    ),
    "a reference beyond the end": Case(
        saved(PACKED),
        2,
        "DIR/spec.yaml:6:10: render.reference: expected a frame of the capture, 0 to 39, got 40\n" + ONE_PROBLEM,
        ("10}}\n", "10}}\nrender: {reference: 40}\n"),
    ),
    "all zero": Case(
        saved(0 * PACKED),
        1,
        "error: DIR/spec.yaml:2:1: source: no pixel is lit in any of 40 frames sampled all over the capture; "
        "check that the file is the right one, and that the lens was open\n",
    ),
    "all one": Case(
        saved(0 * PACKED + 255),
        1,
        "error: DIR/spec.yaml:2:1: source: every pixel is lit in all of 40 frames sampled all over the capture, "
        "so the flux cannot be estimated; "
        "check the layout of the file, or expose less\n",
    ),
    "a file in the way": Case(
        with_a_file_in_the_way,
        1,
        "error: DIR/runs/spec: the run folder cannot be written to (Not a directory); choose another one with --output\n",
    ),
    "no texture": Case(
        saved(BLANK_WALL),
        1,
        "error: level 1: none of the 6 pairs of exposures could be located\n"
        "  frames 10 to 19 onto frames 0 to 9: direct: where the images overlap after alignment, nothing stands out from "
        "photon noise; opencv-sift: # matches, fewer than min_inliers = 12 (# and # keypoints)\n"
        "  frames 20 to 29 onto frames 0 to 9: direct: where the images overlap after alignment, nothing stands out from "
        "photon noise; opencv-sift: # matches, fewer than min_inliers = 12 (# and # keypoints)\n"
        "  frames 20 to 29 onto frames 10 to 19: direct: where the images overlap after alignment, nothing stands out from "
        "photon noise; opencv-sift: # matches, fewer than min_inliers = 12 (# and # keypoints)\n"
        "  frames 30 to 39 onto frames 10 to 19: direct: where the images overlap after alignment, nothing stands out from "
        "photon noise; opencv-sift: # matches, fewer than min_inliers = 12 (# and # keypoints)\n"
        "  frames 30 to 39 onto frames 20 to 29: direct: where the images overlap after alignment, nothing stands out from "
        "photon noise; opencv-sift: # matches, fewer than min_inliers = 12 (# and # keypoints)\n"
        "  frames 30 to 39 onto frames 0 to 9: direct: where the images overlap after alignment, nothing stands out from "
        "photon noise; opencv-sift: # matches, fewer than min_inliers = 12 (# and # keypoints)\n"
        "In these exposures of 10 frames the scene varies # times as much as a pixel's photon noise: either they are too dark "
        "(try larger groups, such as resample.with.group_size=20), or the scene has no texture there.\n"
        "If the image turns or shifts at a constant velocity, write motion: {start: constant-velocity}.\n"
        "report    DIR/runs/spec.failed.html\n",
    ),
}


def pattern(golden: str, folder: Path) -> str:
    return re.escape(golden.replace("DIR", str(folder))).replace(r"\#", r"\d+(?:\.\d+)?")


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_wrong_input_exits_with_message_and_leaves_nothing(tmp_path: Path, case: Case) -> None:
    case.arrange(tmp_path)
    (tmp_path / "spec.yaml").write_text(SPEC.replace(*case.change) if case.change[0] else SPEC)
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(app, ["run", str(tmp_path / "spec.yaml")])
    assert re.fullmatch(pattern(case.golden, tmp_path), result.stderr), result.stderr
    assert (result.exit_code, result.stdout) == (case.code, "")
    report = tmp_path / "runs" / "spec.failed.html"
    assert report.exists() == ("report    " in case.golden)
    assert {*tmp_path.rglob("*")} == {*before} | ({report, report.parent} if report.exists() else set())


def test_run_accepts_width_not_multiple_of_eight(simulated: Callable[..., Path], tmp_path: Path) -> None:
    capture = simulated(n_frames=80, frame_shape=[128, 157], path={"kind": "pan", "length_px": 15})
    spec = SPEC.replace("path: cube.npy", f"path: {capture}, width: 157").replace("size: 10", "size: 40") + "levels: 1\n"
    (tmp_path / "spec.yaml").write_text(spec)
    result = CliRunner().invoke(app, ["run", str(tmp_path / "spec.yaml")])
    assert result.exit_code == 0, result.stderr
    with np.load(tmp_path / "runs" / "spec" / "trajectory.npz") as archive:
        assert tuple(archive["frame_shape"]) == (128, 157)


def limit_files() -> None:
    """Limit files to 20 kB, as on a full disk."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))


def test_full_disk_keeps_earlier_run(simulated: Callable[..., Path], tmp_path: Path) -> None:
    capture = simulated(n_frames=80, path={"kind": "pan", "length_px": 15})
    (tmp_path / "spec.yaml").write_text(SPEC.replace("cube.npy", str(capture)).replace("size: 10", "size: 40") + "levels: 1\n")
    folder = tmp_path / "runs" / "spec"
    folder.mkdir(parents=True)
    for name in ("panorama.tiff", "run.json"):
        (folder / name).write_text("of an earlier run")
    command = [
        sys.executable,
        "-c",
        "from photonpano.cli import main; main()",
        "run",
        str(tmp_path / "spec.yaml"),
        "--overwrite",
    ]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit_files)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        f"error: {folder}: the results could not be written (File too large); what was there before is unchanged. "
        "Make room, or choose another folder with --output"
    )
    assert {file.name: file.read_text() for file in folder.iterdir()} == {
        "panorama.tiff": "of an earlier run",
        "run.json": "of an earlier run",
    }
