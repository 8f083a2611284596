"""Captures with exposures that cannot be located: tolerated gaps, messages, and suggestions."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import LocationError, OutputError
from photonpano import run as run_plan
from photonpano.specs import parse_spec

pytestmark = pytest.mark.usefixtures("without_report")


def spec_of(capture: Path) -> dict[str, Any]:
    return {"version": 1, "source": {"use": "packed-npy", "with": {"path": str(capture)}}, "levels": 1, "refine": []}


@pytest.fixture(scope="module")
def run(outcome_of: Callable) -> Callable[..., Any]:
    return lambda capture, *overrides: outcome_of(parse_spec(spec_of(capture), overrides=overrides))


def lines_of(error: LocationError) -> list[str]:
    """Return the lines of an error, with # for counts and for the reasons of the first locator."""
    lines = str(error).splitlines()
    lines = [re.sub(r"direct: [^;]+;", "direct: #;", re.sub("; as a rotation: .*", "", line)) for line in lines]
    lines = [re.sub(r"\d+(?= (matches|and|keypoints))", "#", line) if line.startswith("  frames") else line for line in lines]
    return [re.sub(r"[\d.]+(?= times)", "#", line) for line in lines]


def refusal(run: Callable, capture: Path, *overrides: str) -> list[str]:
    with pytest.raises(LocationError) as caught:
        run(capture, *overrides)
    return lines_of(caught.value)


def pair(moving: str, fixed: str) -> str:
    reasons = "direct: #; opencv-sift: # matches, fewer than min_inliers = 12 (# and # keypoints)"
    return f"  frames {moving} onto frames {fixed}: {reasons}"


@pytest.fixture(scope="module")
def with_a_wall(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, int], Path]:
    """Cover the scene with a surface without texture, from one frame to another."""

    def with_a_wall(start: int, stop: int) -> Path:
        frames = np.load(small_capture)
        wall = np.random.default_rng(0).random((stop - start, 128, 160)) < 0.4
        frames[start:stop] = np.packbits(wall, axis=-1)
        path = tmp_path_factory.mktemp("wall") / "cube.npy"
        np.save(path, frames)
        return path

    return with_a_wall


def test_failed_run_leaves_a_report_until_a_run_succeeds(with_a_wall: Callable, tmp_path: Path) -> None:
    """A long span without texture separates two parts, of which the smaller one is lost too; the largest can be rendered."""
    spec, out = spec_of(with_a_wall(50, 150)) | {"resample": {"with": {"group_size": 25}}}, tmp_path / "runs" / "run"
    with pytest.raises(LocationError) as caught:
        run_plan(parse_spec(spec, output=out))
    lines = lines_of(caught.value)
    assert re.fullmatch(
        r"level 1: \d+ of \d+ pairs of exposures could not be located, so that frames 0 to 149 cannot be tied to the rest",
        lines[0],
    )
    assert lines[1] == "Parts that are tied together: frames 150 to 299; frames 0 to 49."
    assert lines[2:5] == [pair("50 to 74", "0 to 24"), pair("50 to 74", "25 to 49"), pair("75 to 99", "25 to 49")]
    assert re.fullmatch(r"  \.\.\. and \d+ more", lines[8])
    assert lines[9:] == [
        "In these exposures of 25 frames the scene does not stand out from a pixel's photon noise: either they are too dark "
        "(try larger groups, such as resample.with.group_size=50), or the scene has no texture there.",
        "To go on with the largest part alone, set graph.disconnected to largest.",
        "motion: {start: constant-velocity} was tried, too: what varies over time stays at its place in the frame, "
        "and so shows no motion",
        lines[12],
    ]
    assert lines[12].startswith("motion: {start: smooth-path} was tried, too: ")
    report = caught.value.report
    assert report is not None
    assert report.name == "run.failed.html"
    assert [file.name for file in report.parent.iterdir() if not file.name.startswith(".")] == [report.name]

    largest = spec | {"graph": {"disconnected": "largest"}, "render": {"reference": "first"}}
    record = run_plan(parse_spec(largest, output=out)).record
    assert not report.exists()
    with np.load(out / "trajectory.npz") as trajectory:
        np.testing.assert_array_equal(np.flatnonzero(trajectory["located"]), np.arange(150, 300))
        assert trajectory["reference"] == 150  # the located frame that is next to the first
        np.testing.assert_allclose(trajectory["homographies"][150], np.eye(3), atol=1e-12)
    warnings = record["warnings"]
    assert warnings[0] == "150 of 300 frames lie outside the located exposures and are left out"
    assert all("is uncertain: its expected error exceeds" in warning for warning in warnings[1:-1])
    assert warnings[-1] == "level 1: 6 of 12 exposures are not located (frames 0 to 24 and others)"


def test_failure_distinguishes_dark_from_blurred(run: Callable, simulated: Callable) -> None:
    lines = refusal(run, simulated(flux=0.0005), "resample.with.group_size=50")
    assert lines[:3] == [
        "level 1: none of the 14 pairs of exposures could be located",
        pair("50 to 99", "0 to 49"),
        pair("100 to 149", "0 to 49"),
    ]
    starts = [f"motion: {{start: {each}}} was tried, too: " for each in ("constant-velocity", "smooth-path")]
    assert all(map(str.startswith, lines[-2:], starts))
    assert lines[-3] == (
        "In these exposures of 50 frames the scene does not stand out from a pixel's photon noise: either they are too dark "
        "(try larger groups, such as resample.with.group_size=100), or the scene has no texture there."
    )
    fast = simulated(path={"kind": "random-spline", "length_px": 1500, "knots": 12, "seed": 3})
    lines = refusal(run, fast, "resample.with.group_size=100")
    assert lines[-1].startswith(starts[0])
    assert lines[:-1] == [
        "level 1: none of the 3 pairs of exposures could be located",
        pair("100 to 199", "0 to 99"),
        pair("200 to 299", "0 to 99"),
        pair("200 to 299", "100 to 199"),
        "In these exposures of 100 frames the scene varies # times as much as a pixel's photon noise: either motion blurs them "
        "(try smaller groups, such as resample.with.group_size=50), or they are too dark for what texture there is (try larger "
        "ones, such as resample.with.group_size=200).",
    ]


@pytest.mark.parametrize("obstacle", ["render_failure", "atomic_path"])
def test_failure_of_the_report_does_not_hide_that_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, obstacle: str
) -> None:
    def fail(*_: object) -> None:
        raise OutputError("the disk is full")

    monkeypatch.setattr(f"photonpano.pipeline.run.{obstacle}", fail)
    np.save(tmp_path / "cube.npy", np.random.default_rng(0).integers(0, 256, (80, 48, 8), dtype=np.uint8))
    with pytest.raises(LocationError) as caught:
        run_plan(
            parse_spec(spec_of(tmp_path / "cube.npy"), overrides=("resample.with.group_size=20",), output=tmp_path / "run")
        )
    assert caught.value.report is None
