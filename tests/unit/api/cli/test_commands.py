"""What commands find, write and print; the rest of what they print is in the transcripts."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from photonpano.specs import parse_spec
from photonpano.values import Reason

SPEC = "version: 1\nsource: {use: packed-npy, with: {path: covered.npy}}\n"


@pytest.fixture
def cube(folder: Path, finished: Path) -> Path:
    """A simulated capture in the current folder: 200 frames, a pan of 0.1 px a frame."""
    return Path(shutil.copy(finished / "cube.npy", folder / "cube.npy"))


def test_info_group_size_is_that_of_run(cube: Path, invoke: Callable[..., Any]) -> None:
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    (cube.parent / "scan.yaml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy}}\nlevels: 1\n")
    assert invoke("run", "scan.yaml").exit_code == 0
    decisions = json.loads((cube.parent / "runs" / "scan" / "run.json").read_text())["decisions"]
    found = {each["what"]: (each["value"], each["reason"]) for each in decisions}
    assert found.pop("motion_model")[0] == "homography"
    assert found.pop("chunk_frames")[0] <= 10  # frames that move less than 1 px
    assert found == {
        "source": ("packed-npy", facts["reason"]),
        "still_pixels": (0, facts["still_how"]),
        "standing_share": (
            facts["standing_share"],
            "share of the frame that stands still, of the parts that show motion or rest",
        ),
        "group_size": (facts["group_size"], facts["group_size_reason"]),
    }


def test_dark_counts_and_masks_are_those_of_the_camera(folder: Path, invoke: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    hot = rng.random((24, 32)) < 0.03
    frames = rng.random((1000, 24, 32)) < -np.expm1(-np.where(hot, 0.5, 0.002))
    np.save("covered.npy", np.packbits(frames, axis=-1))
    Path("covered.yaml").write_text(SPEC)
    done = invoke("dark", "covered.yaml", "--output", "dark.npz"), invoke("dark", "covered.npy", "-o", "mask.npy")
    with np.load("dark.npz") as archive:
        assert sorted(archive.files) == ["n_frames", "rates"]
        assert archive["rates"][hot].mean() == pytest.approx(0.5, rel=0.1)
        assert archive["rates"][~hot].mean() == pytest.approx(0.002, rel=0.1)
    np.testing.assert_array_equal(np.load("mask.npy"), hot)
    corrections = [parse_spec(f"{SPEC}{each.stdout.splitlines()[-1]}\n", directory=folder).corrections for each in done]
    assert list(map(len, corrections)) == [2, 1]
    invoke("dark", "covered.yaml", "-o", "rotated.npz", "--correct", "rot90", "--correct", "{crop: {rows: [0, 10]}}")
    with np.load("rotated.npz") as archive:
        assert archive["rates"].shape == (10, 24)


@pytest.mark.usefixtures("cube")
def test_preview_writes_pictures_and_films(invoke: Callable[..., Any]) -> None:
    invoke("preview", "cube.npy", "-o", "look", "--group-size", "50", "--step", "75", "--white", "1.5")
    files = sorted(Path("look").iterdir())
    assert [file.name for file in files] == ["frame_000.png", "frame_075.png", "frame_150.png"]
    assert {cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape for file in files} == {(110, 160)}
    invoke("preview", "cube.npy", "-o", "look.webp", "--group-size", "20", "--fps", "10", "--no-label")
    with Image.open("look.webp") as film:
        assert (film.n_frames, film.size) == (10, (160, 96))


def test_run_prints_only_verdict_paths_and_warnings_into_pipe(finished: Path) -> None:
    record = json.loads((finished / "run" / "run.json").read_text())
    refined = [line for line in (finished / "run.out").read_text().splitlines(keepends=True) if line.startswith("refined ")]
    assert len(refined) == sum(bool(each["rounds"]) for each in record["refinements"])
    panorama = record["panorama"]
    decibels, measurable = panorama["dynamic_range_db"], panorama["measurable_range_db"]
    assert (finished / "run.out").read_text() == (
        f"verdict   {record['verdict']['status']}\n{''.join(refined)}"
        f"found     homographies, from groups of {record['levels'][-1]['group_frames']} frames\n"
        f"detail    down to {record['detail']['finest_px']:.2g} px is real: all that the grid holds\n"
        f"range     {decibels:.0f} dB, of {measurable:.0f} dB that the frames over a pixel can measure; "
        f"{100 * panorama['saturated_share']:.2g} % of the pixels are saturated\n"
        f"panorama  {finished}/run/panorama.png\nreport    {finished}/run/report.html\n"
    )
    reasons = [f"doubtful: {Reason(**reason)}\n" for reason in record["verdict"]["reasons"]]
    warnings = [f"warning: {warning}\n" for warning in record["warnings"]]
    lines = (finished / "run.err").read_text().splitlines(keepends=True)
    assert [line for line in lines if " after " not in line] == [*reasons, *warnings]  # a slow machine has lines of progress


def test_evaluate_table_agrees_with_json(finished: Path, invoke: Callable[..., Any]) -> None:
    arguments = ["evaluate", finished / "run", "--truth", finished / "cube.truth.npz"]
    table = invoke(*arguments)
    assert table.exit_code == 0, table.stderr
    rows = dict(line.split("  ", 1) for line in table.stdout.splitlines())
    scores = json.loads(invoke(*arguments, "--json").stdout)
    assert {key.strip(): value.strip() for key, value in rows.items()} == {
        "corner error, mean": f"{scores['corner_error_px']['mean']:.3f} px",
        "corner error, median": f"{scores['corner_error_px']['median']:.3f} px",
        "corner error, 95 %": f"{scores['corner_error_px']['p95']:.3f} px",
        "corner error, worst frame": f"{scores['corner_error_px']['max']:.3f} px",
        "frames located": f"{100 * scores['located_share']:.1f} %",
        "frames within 3 std_px": f"{100 * scores['within_three_std_share']:.1f} %",
        "PSNR, panorama": f"{scores['panorama']['psnr_db']:.2f} dB",
        "SSIM, panorama": f"{scores['panorama']['ssim']:.4f}",
        "PSNR, oracle": f"{scores['oracle']['psnr_db']:.2f} dB",
        "SSIM, oracle": f"{scores['oracle']['ssim']:.4f}",
        "PSNR below the oracle": f"{scores['below_oracle_db']:.2f} dB",
    }
    assert scores["corner_error_px"]["mean"] < 1


SLOWLY = """
import time
from photonpano.api.cli.app import main
from photonpano.capture import writing
writing._BLOCK_BYTES = 20 * 96 * 20
of = writing.PackedFrames.of
def slowly(self, span):
    time.sleep(0.05)
    return of(self, span)
writing.PackedFrames.of = slowly
main()
"""


def heed_interrupts() -> None:
    """Restore SIGINT, which shells disable in their background jobs."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_convert_continues_after_interrupt(cube: Path, invoke: Callable[..., Any], sent: signal.Signals) -> None:
    part, command = cube.parent / "out.npy.part", [sys.executable, "-c", SLOWLY, "convert", "cube.npy", "out.npy"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=cube.parent, text=True, preexec_fn=heed_interrupts, **pipes) as process:
        while not (part.exists() and part.stat().st_size > 128) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(sent)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (128 + sent, "")
    assert err == (
        "the frames written so far are in out.npy.part; the same command continues from there\n"
        "\ninterrupted; no file is left half-written under its final name\n"
    )
    assert sorted(path.name for path in cube.parent.iterdir()) == ["capture.yaml", "cube.npy", "out.npy.part"]
    there = (part.stat().st_size - 128) // (96 * 20)
    result = invoke("convert", "cube.npy", "out.npy")
    assert result.stderr == f"out.npy.part holds {there} frames of this capture: continuing from there\n"
    assert (cube.parent / "out.npy").read_bytes() == cube.read_bytes()
    assert not part.exists()


def test_convert_onto_itself_keeps_capture(cube: Path, invoke: Callable[..., Any]) -> None:
    """The old file stays open until the new one replaces it."""
    before, truth = cube.read_bytes(), cube.with_name("cube.truth.npz")
    truth.touch()
    assert invoke("convert", "cube.npy", "cube.npy", "--overwrite").exit_code == 0
    assert cube.read_bytes() == before
    truth.unlink()


def test_check_refuses_the_capture_as_output(cube: Path, invoke: Callable[..., Any]) -> None:
    source = "source: {use: packed-npy, with: {path: cube.npy}}"
    Path("wrong.yaml").write_text(f"version: 1\n{source}\noutput: {{directory: cube.npy}}\n")
    result = invoke("check", "wrong.yaml")
    assert result.exit_code == 1
    assert f"{cube.absolute()} cannot be written, since {cube.absolute()}, which is read, lies in it" in result.stderr
