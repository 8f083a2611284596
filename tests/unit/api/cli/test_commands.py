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
from ruamel.yaml import YAML

from photonpano.photometry import srgb_to_linear
from photonpano.specs import load_spec, parse_spec
from photonpano.values import Reason
from photonpano_simulator.travel import read_truth, sharp_view

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


def test_info_finds_hot_and_saturated_pixels(folder: Path, invoke: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    frames = rng.random((600, 64, 64)) < 0.1
    frames[:, rng.random((64, 64)) < 0.02] = True
    frames[:, :8] = True
    np.save(folder / "cube.npy", np.packbits(frames, axis=-1))
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    assert facts["hot_share"] == pytest.approx(0.02 * 7 / 8, abs=0.006)
    assert facts["saturated_share"] == pytest.approx(frames.all(axis=0).mean())


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


def test_simulate_prints_files_and_spec_section(finished: Path) -> None:
    assert (finished / "simulate.err").read_text() == ""
    size = (finished / "cube.truth.npz").stat().st_size
    assert (finished / "simulate.out").read_text() == (
        "cube.npy        384.1 kB  200 binary frames of 96x160 at 96,800 Hz\n"
        f"cube.truth.npz  {size / 1000:.1f} kB  the truth: motion and scene\n"
        "\n"
        "In a spec in this folder:\n"
        "\n"
        "source: {use: packed-npy, with: {path: cube.npy, frame_rate_hz: 96800}}\n"
        "\n"
        "To score a run of it: photonpano evaluate RUN --truth cube.truth.npz\n"
    )


def test_simulate_prints_valid_spec_section(finished: Path) -> None:
    line = next(line for line in (finished / "simulate.out").read_text().splitlines() if line.startswith("source:"))
    plan = parse_spec(f"version: 1\n{line}\n", directory=finished)
    assert plan.source.contribution.name == "packed-npy"


def test_run_prints_only_verdict_paths_and_warnings_into_pipe(finished: Path) -> None:
    record = json.loads((finished / "run" / "run.json").read_text())
    refined = [line for line in (finished / "run.out").read_text().splitlines(keepends=True) if line.startswith("refined ")]
    assert len(refined) == sum(bool(each["rounds"]) for each in record["refinements"])
    panorama = record["panorama"]
    decibels, measurable = panorama["dynamic_range_db"], panorama["measurable_range_db"]
    assert (finished / "run.out").read_text() == (
        f"verdict   {record['verdict']['status']}\n{''.join(refined)}"
        f"range     {decibels:.0f} dB, of {measurable:.0f} dB that the frames over a pixel can measure; "
        f"{100 * panorama['saturated_share']:.2g} % of the pixels are saturated\n"
        f"panorama  {finished}/run/panorama.png\nreport    {finished}/run/report.html\n"
    )
    reasons = [f"doubtful: {Reason(**reason)}\n" for reason in record["verdict"]["reasons"]]
    warnings = [f"warning: {warning}\n" for warning in record["warnings"]]
    lines = (finished / "run.err").read_text().splitlines(keepends=True)
    assert [line for line in lines if " after " not in line] == [*reasons, *warnings]  # a slow machine has lines of progress


def test_check_run_agrees_with_run(finished: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("check-run", finished / "run")
    assert result.stdout.splitlines()[0] == (finished / "run.out").read_text().splitlines()[0]


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


def test_schema_is_printed_or_written(folder: Path, invoke: Callable[..., Any]) -> None:
    printed = json.loads(invoke("schema").stdout)
    assert {"version", "source", "levels"} <= set(printed["properties"])
    assert invoke("schema", "--output", "schema.json").stdout == "schema.json\n"
    assert json.loads((folder / "schema.json").read_text()) == printed


@pytest.mark.parametrize(
    "changes", [["levels=until-converged"], ["resample.with.group_size=auto"], ["levels=[{scale: 0.5}, {}]", "run.seed=3"]]
)
def test_explanation_is_the_same_spec(folder: Path, invoke: Callable[..., Any], changes: list[str]) -> None:
    printed = invoke("explain", "capture.yaml", *(word for change in changes for word in ("--set", change))).stdout
    assert YAML(typ="safe").load(printed) == parse_spec(printed).document == load_spec("capture.yaml", changes).document


def test_printed_sections_are_parts_of_specs(finished: Path, invoke: Callable[..., Any]) -> None:
    snippet = invoke("plugins", "show", "packed-npy").stdout.split("\n\n")[-1].replace('"<path>"', "cube.npy")
    spec = invoke("info", finished / "cube.npy").stdout.partition("start from:\n")[2]
    for text in (f"version: 1\n{snippet}", spec):
        assert parse_spec(text, directory=finished).source.contribution.name == "packed-npy"


TRAVEL = """
version: 1
source:
  use: travel-simulator
  with: {scene: {kind: planes}, n_frames: 25, frame_shape: [24, 32], focal_px: 25, sensor: {dark_rate: 0.3}}
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("depth.yaml").write_text(TRAVEL)
    return tmp_path


def test_sharp_frames_are_views_without_noise(here: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("simulate", "depth.yaml", "-o", "cube.npy", "--sharp-every", "10")
    assert done.exit_code == 0, done.output
    assert [file.name for file in sorted(Path("cube.sharp").iterdir())] == [f"frame_0000{n}.png" for n in ("00", "10", "20")]
    lines = done.stdout.splitlines()
    assert lines[2].startswith("cube.sharp ")
    assert lines[2].endswith("3 frames without noise")
    assert lines[-1] == "To score a run with `pose` of it: photonpano evaluate RUN --truth cube.truth.npz"
    truth = read_truth("cube.truth.npz")
    levels = np.stack([cv2.imread(f"cube.sharp/frame_0000{n}.png", cv2.IMREAD_UNCHANGED) for n in (10, 20)])
    flux = np.stack([sharp_view(truth, n) for n in (10, 20)])
    assert levels.dtype == np.uint8
    unsaturated = levels < 255
    shown = srgb_to_linear((levels[unsaturated] / 255).astype(np.float32))
    white = np.median(flux[unsaturated] / shown)
    np.testing.assert_allclose(shown * white, flux[unsaturated], atol=0.012 * white)


@pytest.mark.parametrize("steps", [("out.npy",), ("out.zarr", "out.npy"), ("out.zarr --compress", "out.npy")], ids=" ".join)
def test_convert_copies_bits(cube: Path, invoke: Callable[..., Any], steps: tuple[str, ...]) -> None:
    if "--compress" in steps[0]:
        pytest.importorskip("numcodecs", reason="compression needs photonpano[zarr]")
    for source, words in zip(("cube.npy", "out.zarr"), steps, strict=False):
        assert invoke("convert", source, *words.split()).exit_code == 0
    assert (cube.parent / "out.npy").read_bytes() == cube.read_bytes()


def test_convert_applies_corrections_of_option(cube: Path, invoke: Callable[..., Any]) -> None:
    assert (
        invoke("convert", "cube.npy", "out.npy", "--correct", "{crop: {columns: [0, 43]}}", "--correct", "flip-lr").exit_code
        == 0
    )
    frames = np.unpackbits(np.load(cube), axis=-1)
    found = np.unpackbits(np.load(cube.parent / "out.npy"), axis=-1, count=43)
    np.testing.assert_array_equal(found, frames[:, :, 42::-1])


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


def test_convert_leaves_no_truth_of_another_capture(cube: Path, invoke: Callable[..., Any]) -> None:
    (truth := cube.with_name("out.truth.npz")).write_bytes(b"that of another one")
    assert invoke("convert", "cube.npy", "out.npy").stderr == (
        "error: out.truth.npz is there already; choose another name, or replace it with --overwrite\n"
    )
    assert invoke("convert", "cube.npy", "out.npy", "--overwrite").stderr == (
        "error: out.truth.npz is the truth of the capture that out.npy would replace; move it away, or choose another name\n"
    )
    assert truth.read_bytes() == b"that of another one"


def test_convert_keeps_the_truth_that_both_share(cube: Path, invoke: Callable[..., Any]) -> None:
    (truth := cube.with_name("cube.truth.npz")).touch()
    assert invoke("convert", "cube.npy", "cube.zarr", "--with", "frame_rate_hz=96800").exit_code == 0
    assert truth.exists()
    truth.unlink()


def test_convert_onto_itself_keeps_capture(cube: Path, invoke: Callable[..., Any]) -> None:
    """The old file stays open until the new one replaces it."""
    before, truth = cube.read_bytes(), cube.with_name("cube.truth.npz")
    truth.touch()
    assert invoke("convert", "cube.npy", "cube.npy", "--overwrite").exit_code == 0
    assert cube.read_bytes() == before
    truth.unlink()
