from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano.api.info import percent
from photonpano.specs import parse_spec


@pytest.fixture
def cube(folder: Path, finished: Path) -> Path:
    """A simulated capture in the current folder: 200 frames, a pan of 0.1 px a frame."""
    shutil.copy(finished / "cube.npy", folder / "cube.npy")
    return folder / "cube.npy"


def rows_of(printed: str) -> dict[str, str]:
    table = printed.partition("\n\n")[0]
    return {line[:10].strip(): line[10:].strip() for line in table.splitlines()}


def test_info_prints_facts_and_valid_spec(cube: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("info", "cube.npy", "--with", "frame_rate_hz=96800")
    assert (result.exit_code, result.stderr) == (0, "")
    rows = rows_of(result.stdout)
    assert rows["source"] == "packed-npy (cube.npy was recognised: uint8 of shape (200, 96, 20) in a .npy file)"
    assert rows["capture"] == "200 binary frames of 96x160 at 96,800 Hz"
    assert rows["duration"] == "2.07 ms"
    flux, _, unit = rows["flux"].partition(" ")
    assert unit == "photons per pixel per frame"
    assert 0.5 < float(flux) < 2
    assert rows["hot pixels"].startswith(("none", "about "))
    assert rows["speed"].startswith("0.1 px per frame (the second fastest of ")
    assert rows["group size"].startswith("25: at 0.1 px per frame ")
    assert result.stdout.endswith(
        "\n\nA spec to start from:\n\nversion: 1\nsource: {use: packed-npy, with: {path: cube.npy, frame_rate_hz: 96800}}\n"
    )
    plan = parse_spec(result.stdout.partition("start from:\n")[2], directory=cube.parent)
    assert plan.source.config.path == cube


def test_info_group_size_is_that_of_run(cube: Path, invoke: Callable[..., Any]) -> None:
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    (cube.parent / "scan.yaml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy}}\nlevels: 1\n")
    assert invoke("run", "scan.yaml").exit_code == 0
    decisions = json.loads((cube.parent / "runs" / "scan" / "run.json").read_text())["decisions"]
    assert {each["what"]: (each["value"], each["reason"]) for each in decisions} == {
        "source": ("packed-npy", facts["reason"]),
        "still_pixels": (0, facts["still_how"]),
        "standing_share": (
            facts["standing_share"],
            "share of the frame that stands still, of the parts that show motion or rest",
        ),
        "group_size": (facts["group_size"], facts["group_size_reason"]),
    }


def test_info_json_holds_all_facts(cube: Path, invoke: Callable[..., Any]) -> None:
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    assert {key: facts[key] for key in ("source", "n_frames", "height", "width", "kind", "bit_depth", "warnings")} == {
        "source": "packed-npy",
        "n_frames": 200,
        "height": 96,
        "width": 160,
        "kind": "binary",
        "bit_depth": 1,
        "warnings": [],
    }
    assert facts["frame_rate_hz"] is facts["seconds"] is None
    assert facts["speed_px"] == pytest.approx(0.1, abs=0.02)
    assert facts["unused_share"] == facts["saturated_share"] == 0
    assert facts["spec"] == {"version": 1, "source": {"use": "packed-npy", "with": {"path": "cube.npy"}}}


def test_info_ignores_group_size_of_spec(cube: Path, invoke: Callable[..., Any]) -> None:
    (cube.parent / "scan.yaml").write_text(
        "version: 1\nsource: {use: packed-npy, with: {path: cube.npy}}\ncorrections: [rot90]\n"
        "resample: {with: {group_size: 7}}\nlevels: [{resample: {with: {group_size: 9}}}, {}]\n"
    )
    facts = json.loads(invoke("info", "scan.yaml", "--with", "frame_rate_hz=5", "--json").stdout)
    assert (facts["height"], facts["width"], facts["group_size"]) == (160, 96, 25)
    assert (facts["reason"], facts["frame_rate_hz"]) == (None, 5)
    assert facts["spec"]["corrections"] == ["rot90"]


def test_info_keeps_corrections_in_printed_spec(cube: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("info", "cube.npy", "--correct", "flip-ud", "--correct", "{crop: {rows: [2, null]}}")
    assert rows_of(result.stdout)["capture"] == "200 binary frames of 94x160"
    assert rows_of(result.stdout)["duration"] == "unknown without frame_rate_hz"
    plan = parse_spec(result.stdout.partition("start from:\n")[2], directory=cube.parent)
    assert len(plan.corrections) == 2


@pytest.mark.parametrize(
    ("value", "flux", "warning"),
    [
        (0, 0, "no pixel is lit in any of 256 frames sampled all over the capture; check that the file is the right one, "),
        (255, 7.2, "every pixel is lit in all of 256 frames sampled all over the capture, so the flux cannot be estimated; "),
    ],
)
def test_info_warns_of_dark_and_saturated_captures(
    folder: Path, invoke: Callable[..., Any], value: int, flux: float, warning: str
) -> None:
    np.save(folder / "cube.npy", np.full((600, 32, 4), value, np.uint8))
    result = invoke("info", "cube.npy")
    assert result.exit_code == 0
    assert result.stderr.startswith(f"warning: {warning}")
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    assert facts["saturated_share"] == (value == 255)
    assert facts["speed_px"] is None
    assert facts["flux"] == 0 if not flux else facts["flux"] > 3


def test_info_warns_of_hot_and_saturated_pixels(folder: Path, invoke: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    frames = rng.random((600, 64, 64)) < 0.1
    frames[:, rng.random((64, 64)) < 0.02] = True
    frames[:, :8] = True
    np.save(folder / "cube.npy", np.packbits(frames, axis=-1))
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    assert facts["hot_share"] == pytest.approx(0.02 * 7 / 8, abs=0.006)
    assert facts["saturated_share"] == pytest.approx(frames.all(axis=0).mean())
    hot, *_, saturated = invoke("info", "cube.npy").stderr.splitlines()
    assert (
        hot == f"warning: about {percent(facts['hot_share'])} of the pixels are hot; mask them with the correction hot-pixels"
    )
    assert saturated.startswith("warning: 14 % of the pixels have their highest value in every frame, so that ")


def test_info_warns_of_frame_that_stands_still(folder: Path, invoke: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    chances = 0.3 * cv2.GaussianBlur(rng.random((64, 64)), (0, 0), 2) ** 2 / 0.25
    np.save(folder / "cube.npy", np.packbits(rng.random((600, 64, 64)) < chances, axis=-1))
    (warning,) = invoke("info", "cube.npy").stderr.splitlines()
    assert warning == (
        "warning: 100% of the frame stands still; if the camera moved, mask what is not the scene with the correction mask"
    )


def test_info_warns_of_capture_too_short_for_groups(folder: Path, invoke: Callable[..., Any]) -> None:
    np.save(folder / "cube.npy", np.random.default_rng(0).integers(0, 256, (5, 32, 4), np.uint8))
    result = invoke("info", "cube.npy")
    assert result.exit_code == 0
    rows = rows_of(result.stdout)
    assert (rows["speed"], rows["group size"]) == ("5 frames are too few to estimate a motion", "unknown")
    assert "warning: the capture has 5 frames, " in result.stderr


def test_info_finds_order_of_pixels_and_prints_it_in_spec(folder: Path, invoke: Callable[..., Any], clouds: Callable) -> None:
    np.save(folder / "cube.npy", np.packbits(clouds(), axis=1, bitorder="little"))
    result = invoke("info", "cube.npy")
    assert (result.exit_code, result.stderr) == (0, "")
    assert rows_of(result.stdout)["capture"] == "384 binary frames of 64x96"
    assert result.stdout.endswith(
        "source: {use: packed-npy, with: {path: cube.npy, bit_order: little, packed_along: height}}\n"
    )


def test_info_reads_unpacked_frames(folder: Path, invoke: Callable[..., Any], clouds: Callable) -> None:
    np.save(folder / "cube.npy", clouds())
    result = invoke("info", "cube.npy")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.endswith("source: {use: npy, with: {path: cube.npy, holds: bits}}\n")


def test_info_of_sums_shows_the_line_to_write(folder: Path, invoke: Callable[..., Any], clouds: Callable) -> None:
    path = folder / "cube.npy"
    np.save(path, clouds().reshape(96, 4, 64, 96).sum(axis=1))
    result = invoke("info", "cube.npy")
    assert result.exit_code == 2
    assert result.stderr == (
        f"error: no source recognises {path}, a file of 4,718,720 bytes; name the one that reads it\n"
        f"  packed-npy: cube.npy holds uint64 values, not bytes of eight pixels; write source: {{use: npy, with: {{path: "
        f"{path}, holds: sums, frames_per_sum: 4}}}}, with the number of binary frames in a sum if it is larger\n"
    )
    result = invoke("info", "cube.npy", "--source", "npy", "--with", "holds=sums", "--with", "frames_per_sum=4")
    assert result.exit_code == 0
    assert result.stdout.endswith("source: {use: npy, with: {path: cube.npy, holds: sums, frames_per_sum: 4}}\n")


def test_info_warns_of_stated_order_that_the_frames_contradict(
    folder: Path, invoke: Callable[..., Any], clouds: Callable
) -> None:
    np.save(folder / "cube.npy", np.packbits(clouds(), axis=2, bitorder="little"))
    result = invoke("info", "cube.npy", "--source", "packed-npy", "--with", "bit_order=big")
    assert result.exit_code == 0
    assert result.stderr.startswith(
        "warning: the pixels of the frames seem to be in another order than they are read in: pixels correlate by "
    )
