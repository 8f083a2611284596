"""Frames without light, shots that nothing ties together, and motion that exposures do not show."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import open_source
from photonpano import run as run_plan
from photonpano.execution.context import Context
from photonpano.pipeline.obstacles import timeline_of
from photonpano.specs import parse_spec
from photonpano.values import FrameSpan

pytestmark = pytest.mark.usefixtures("without_report")

PAN = {"kind": "pan", "length_px": 60, "angle_deg": 10}
FIRST = FrameSpan(0, 42), FrameSpan(150, 190)


def spec_of(capture: Path) -> dict[str, Any]:
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(capture)}},
        "resample": {"use": "midpoint", "with": {"group_size": 30}},
        "motion": {"model": "translation"},
        "levels": 2,
        "refine": [],
    }


@pytest.fixture(scope="module")
def shutter_closes(simulated: Callable[..., Path]) -> Path:
    """The shutter is closed at first, and while the camera pans."""
    return simulated(path=PAN, shutter=[[0, 0.14], [0.5, 190 / 300]], sensor={"dark_rate": 0.002})


def dark_spans(capture: Path) -> tuple[FrameSpan, ...]:
    with open_source(parse_spec(spec_of(capture))) as source:
        return timeline_of(source, Context()).dark


def test_frames_without_light_are_found_to_the_frame(shutter_closes: Path) -> None:
    assert dark_spans(shutter_closes) == FIRST


def test_dim_scene_flicker_and_short_darkness_are_no_closed_shutter(small_capture: Path, tmp_path: Path) -> None:
    frames, rng = np.unpackbits(np.load(small_capture), axis=-1), np.random.default_rng(0)
    dim, flickering, short = frames.copy(), frames.copy(), frames.copy()
    dim[100:200] &= rng.random((100, 128, 160)) < 0.15
    short[100:120] = 0
    flickering[np.arange(300) // 16 % 2 == 0] = 0
    for name, each in (("dim", dim), ("short", short), ("flickering", flickering)):
        np.save(tmp_path / f"{name}.npy", np.packbits(each, axis=-1))
        assert dark_spans(tmp_path / f"{name}.npy") == (), name


def test_dark_frames_are_not_located_and_cost_the_others_nothing(
    shutter_closes: Path, simulated: Callable[..., Path], tmp_path: Path
) -> None:
    result = run_plan(parse_spec(spec_of(shutter_closes), output=tmp_path / "run"))
    dark = np.zeros(300, bool)
    for span in FIRST:
        dark[span.start : span.stop] = True
    with np.load(tmp_path / "run" / "trajectory.npz") as motion:
        located, path_px, reference = motion["located"], motion["homographies"][:, :2, 2], motion["reference"]
    np.testing.assert_array_equal(located, ~dark)
    with np.load(shutter_closes.with_suffix(".truth.npz")) as truth:
        true_px = truth["homographies"][:, :2, 2]
    error = (path_px - (true_px - true_px[reference]))[~dark]
    assert np.sqrt(np.mean((error - error.mean(axis=0)) ** 2)) < 0.15
    assert result.record["warnings"][0] == (
        "frames 0 to 41 and frames 150 to 189 show no light, as behind a closed shutter: they are not located, and left out of "
        "the panorama. If the shutter was meant to be open, check it, and the gate of the sensor"
    )
    decided = [(each["what"], each["value"]) for each in result.record["decisions"] if each["what"] == "dark_frames"]
    assert decided == [("dark_frames", "frames 0 to 41"), ("dark_frames", "frames 150 to 189")]
    # As bright as without a shutter.
    open_spec = spec_of(simulated(path=PAN, sensor={"dark_rate": 0.002}))
    run_plan(parse_spec(open_spec, output=tmp_path / "open"))
    assert flux_of(tmp_path / "run") == pytest.approx(flux_of(tmp_path / "open"), rel=0.03)


def flux_of(run: Path) -> float:
    import tifffile

    return float(np.nanmedian(tifffile.imread(run / "panorama.tiff")))


def test_shots_that_nothing_ties_together_are_kept_apart(simulated: Callable[..., Path], tmp_path: Path) -> None:
    elsewhere = {"kind": "street", "width": 1024, "height": 682, "seed": 5}
    first, other = (np.load(simulated(path=PAN, **changes)) for changes in ({}, {"scene": elsewhere}))
    np.save(tmp_path / "cube.npy", np.concatenate([first[:120], other[:180]]))
    result = run_plan(parse_spec(spec_of(tmp_path / "cube.npy"), output=tmp_path / "run"))
    with np.load(tmp_path / "run" / "trajectory.npz") as motion:
        np.testing.assert_array_equal(np.flatnonzero(motion["located"]), np.arange(120, 300))
        assert motion["reference"] == 210
    assert result.record["warnings"][0] == (
        "the capture holds 2 shots that no pair of exposures ties together: frames 0 to 119 and frames 120 to 299. The "
        "panorama is of frames 120 to 299 alone; for one of frames 0 to 119, write source: {with: {frames: [0, 120]}}"
    )
    assert result.verdict is not None
    assert str(result.verdict.reasons[0]) == (
        "the capture holds shots that no pair of exposures ties together, and the panorama is of the longest alone (frames 0 "
        "to 119 and frames 120 to 299): 2, trusted up to 1; make a panorama of each: write "
        "source.with.frames: [first, last + 1]"
    )


def test_constant_velocity_is_tried_where_exposures_are_not_located(simulated: Callable[..., Path], tmp_path: Path) -> None:
    spec = spec_of(simulated(flux=0.001)) | {
        "resample": {"use": "midpoint", "with": {"group_size": 50}},
        "motion": {},
        "levels": 1,
    }
    record = run_plan(parse_spec(spec, output=tmp_path / "run")).record
    start = next(each for each in record["decisions"] if each["what"] == "start")
    assert start["reason"].endswith("; without it, pairs of exposures could not be located")
