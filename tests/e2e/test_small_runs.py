"""Whole runs of a small capture: 300 frames of 128x160 px, a pan of 60 px with a trembling hand, groups of 50 frames."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

import photonpano
from photonpano.captures.writing import truth_path
from photonpano.evaluation import Evaluation, corner_errors
from photonpano.geometry import rescaling, translation
from photonpano.merging.canvas_plan import BYTES_PER_PIXEL
from photonpano.photometry import tone_mapped
from photonpano.pipeline.run import RunResult
from photonpano.specs import Plan, parse_spec

SHAPE = (128, 160)
INSIDE = slice(25, 275)
"""Frames that every level locates; level 1 does not reach the ends of the capture."""


def test_panorama_larger_than_memory_is_written_in_parts(small_spec: dict[str, Any], tmp_path: Path) -> None:
    plan = parse_spec(
        small_spec | {"levels": 1, "output": {"directory": str(tmp_path)}},
        overrides=("render.scale=9", "run.memory=64 MiB"),
    )
    record = photonpano.run(plan).record["panorama"]
    flux, coverage = (tifffile.imread(tmp_path / name) for name in ("panorama.tiff", "coverage.tiff"))
    picture = cv2.imread(str(tmp_path / "panorama.png"), cv2.IMREAD_UNCHANGED)
    factor = record["picture_reduction"]
    assert flux.size * BYTES_PER_PIXEL > 64 * 1024**2
    assert flux.shape == coverage.shape == (record["height"], record["width"])
    assert picture.shape == tuple(-(-side // factor) for side in flux.shape)
    np.testing.assert_array_equal(np.isnan(flux), coverage == 0)
    assert record["coverage_share"] == pytest.approx((coverage > 0).mean())
    # The picture shows the same: bright where the flux is.
    whole = np.s_[: flux.shape[0] // factor * factor, : flux.shape[1] // factor * factor]
    blocks = np.nan_to_num(flux[whole]).reshape(flux.shape[0] // factor, factor, -1, factor).mean(axis=(1, 3))
    shown = picture[: blocks.shape[0], : blocks.shape[1]]
    assert np.corrcoef(np.sqrt(blocks).ravel(), shown.ravel())[0, 1] > 0.98
    assert f"<code>panorama.png</code> one pixel for {factor}" in (tmp_path / "report.html").read_text()


@pytest.fixture(scope="module")
def run(small_spec: dict[str, Any], outcome_of: Callable[[Plan], Any]) -> Callable[..., Any]:
    """Run the small spec with overrides, or with other sections."""

    def run(*overrides: str, **sections: Any) -> Any:
        return outcome_of(parse_spec(small_spec | sections, overrides=overrides))

    return run


@pytest.fixture(scope="module")
def error_px(small_capture: Path) -> Callable[[np.ndarray], float]:
    with np.load(truth_path(small_capture)) as archive:
        true = archive["homographies"]

    def error_px(homographies: np.ndarray) -> float:
        return corner_errors(homographies[INSIDE], true[INSIDE], SHAPE).mean_px

    return error_px


@pytest.fixture(scope="module")
def three_levels(small_run: RunResult) -> np.ndarray:
    with np.load(small_run.directory / "trajectory.npz") as archive:
        return archive["homographies"]


@pytest.fixture(scope="module")
def scored(small_run: RunResult, small_capture: Path) -> Evaluation:
    return photonpano.evaluate(small_run.directory, truth_path(small_capture))


def test_three_levels_estimate_motion_accurately(scored: Evaluation, three_levels: np.ndarray, error_px: Callable) -> None:
    """Measured: 0.16 px; the ends, with a single group, have larger errors."""
    assert error_px(three_levels) < 0.3
    assert scored.trajectory.located_share == 1
    assert scored.trajectory.mean_px < 1


def test_panorama_is_close_to_oracle(scored: Evaluation) -> None:
    """Measured: within 2.1 dB."""
    assert scored.oracle is not None
    assert scored.oracle.psnr_db > 25
    assert scored.oracle.psnr_db - scored.panorama.psnr_db < 3


def test_each_level_reduces_the_error(run: Callable, three_levels: np.ndarray, error_px: Callable) -> None:
    """Measured: 1.2, 0.24 and 0.16 px."""
    errors = [error_px(run(levels=1).homographies), error_px(run(levels=2).homographies), error_px(three_levels)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.9 * errors[1]


def test_constant_groups_are_less_accurate_without_refinement(run: Callable, error_px: Callable) -> None:
    ablation, method = (run(f"resample.use={name}", "refine=[]") for name in ("constant-groups", "midpoint"))
    assert error_px(ablation.homographies) > 1.8 * error_px(method.homographies)


def test_naive_average_is_less_accurate(run: Callable, three_levels: np.ndarray, error_px: Callable) -> None:
    """Measured: 0.10 px, and 0.04 px with compensation; more levels do not help."""
    naive = run("merge.with.compensate=false", levels=2)
    assert error_px(naive.homographies) > 2 * error_px(three_levels)


def test_half_size_first_level_suffices_for_second(run: Callable, error_px: Callable) -> None:
    coarse, fine = run(levels=[{"scale": 0.5}]), run(levels=[{"scale": 0.5}, {}])
    assert error_px(coarse.homographies) < 2.5
    assert error_px(fine.homographies) < 0.4
    assert [level["scale"] for level in fine.record["levels"]] == [0.5, 1.0]


def test_panorama_has_scale_of_spec(run: Callable) -> None:
    once, twice = run(levels=1), run("render.scale=2", levels=1)
    assert twice.flux.shape == (2 * once.flux.shape[0], 2 * once.flux.shape[1])
    np.testing.assert_allclose(twice.canvas, rescaling(2) @ once.canvas, atol=1e-9)
    assert np.nanmean(twice.flux) == pytest.approx(np.nanmean(once.flux), rel=0.02)
    assert twice.coverage.max() == pytest.approx(once.coverage.max(), rel=0.02)


@pytest.mark.parametrize(("reference", "frame"), [("first", 0), ("last", 299), (77, 77)])
def test_panorama_lies_in_plane_of_reference_frame(run: Callable, reference: str | int, frame: int) -> None:
    outcome = run(f"render.reference={reference}", levels=1)
    assert outcome.trajectory["reference"] == frame
    np.testing.assert_allclose(outcome.homographies[frame], np.eye(3), atol=1e-12)
    # A canvas of scale 1 samples the pixels of the reference plane as they are.
    canvas = outcome.canvas
    np.testing.assert_array_equal(canvas, translation(round(canvas[0, 2]), round(canvas[1, 2])))


def test_bytes_of_results_do_not_depend_on_threads(run: Callable) -> None:
    """Levels of four and nine groups: the order in which threads finish must not matter."""
    runs = [run(f"run.threads={threads}", "resample.with.group_size=75", levels=2) for threads in (1, 2, 3)]
    hashes = [{name: content["sha256"] for name, content in each.record["files"].items()} for each in runs]
    assert {"trajectory.npz", "panorama.tiff", "coverage.tiff", "panorama.png"} <= set(hashes[0])
    assert hashes[1:] == hashes[:-1]


@pytest.mark.parametrize("wrong", ["frame rate", "backend"])
def test_run_without_report_keeps_its_results(
    small_spec: dict[str, Any], tmp_path: Path, wrong: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A figure over a time axis without end, and a matplotlib that cannot be used."""
    overrides = ["levels=1"]
    if wrong == "frame rate":
        overrides.append("source.with.frame_rate_hz=1e-320")
    else:
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    plan = parse_spec(small_spec | {"output": {"directory": str(tmp_path / "run")}}, overrides=overrides)
    record = photonpano.run(plan).record
    (warning,) = [each for each in record["warnings"] if "report" in each]
    assert warning.startswith("the report could not be drawn (")
    assert warning.endswith("); all other files of the run are written")
    assert json.loads((tmp_path / "run" / "run.json").read_text()) == json.loads(json.dumps(record))
    assert set(record["files"]) == {"trajectory.npz", "panorama.tiff", "coverage.tiff", "panorama.png"}
    assert photonpano.verify(tmp_path / "run").problems == ()


def test_recorded_spec_repeats_run(run: Callable, outcome_of: Callable) -> None:
    first = run("run.seed=3", levels=1)
    again = outcome_of(parse_spec(json.loads(json.dumps(first.record["spec"]))))
    np.testing.assert_array_equal(again.homographies, first.homographies)
    np.testing.assert_array_equal(again.flux, first.flux)


def test_masked_hot_pixels_do_not_show_in_panorama(simulated: Callable, outcome_of: Callable) -> None:
    """1 % of the pixels are lit in every frame; if they are masked, other frames fill their places."""
    sensor = {"hot_fraction": 0.01, "hot_rate": [5, 6]}
    capture = simulated(path={"kind": "pan", "length_px": 40}, n_frames=120, sensor=sensor)
    with np.load(truth_path(capture)) as archive:
        np.save(capture.with_name("hot.npy"), archive["hot_pixels"])
    source = {"use": "packed-npy", "with": {"path": str(capture)}}
    mask = {"mask": {"file": str(capture.with_name("hot.npy"))}}
    spec = {"version": 1, "source": source, "corrections": [mask], "resample": {"with": {"group_size": 40}}, "levels": 1}
    masked = outcome_of(parse_spec(spec))
    lit = outcome_of(parse_spec(spec, overrides=["corrections=[]"]))
    assert not np.isnan(masked.flux[20:-20, 60:-60]).any()  # the part that all frames saw
    # A streak of light 40 px long behind each of 200 pixels raises the mean.
    assert np.nanmean(lit.flux) > 1.01 * np.nanmean(masked.flux)


@pytest.fixture(scope="module")
def kept(small_spec: dict[str, Any], outcome_of: Callable[[Plan], Any]) -> Any:
    return outcome_of(parse_spec(small_spec, overrides=("output.keep=exposures", "levels=2")))


def test_kept_exposures_are_described_and_pictured(kept: Any) -> None:
    folder = kept.directory / "exposures"
    for level in kept.record["levels"]:
        name = f"level-{level['level']}"
        flux = np.load(folder / f"{name}.npy")
        with np.load(folder / f"{name}.npz") as found:
            frames, instants, located, scale = (found[key] for key in ("frames", "instants", "located", "scale"))
            homographies = found["homographies"]
        assert flux.dtype == np.float32
        assert flux.shape == (level["groups"], round(SHAPE[0] * scale), round(SHAPE[1] * scale))
        assert located.sum() == level["located"]
        assert homographies.shape == (level["groups"], 3, 3)
        assert ((frames[:, 0] <= instants) & (instants < frames[:, 1])).all()
        for number, image in enumerate(flux):
            file = folder / f"{name}-{number:0{len(str(len(flux) - 1))}}.png"
            picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(picture, tone_mapped(image, kept.record["panorama"]["white_flux"]))
    assert {f"exposures/{file.name}" for file in folder.iterdir()} <= set(kept.record["files"])


def test_kept_exposures_lie_where_the_panorama_shows_them(kept: Any) -> None:
    """An exposure of the last level, laid on the panorama by its homography, is like it; by that of another one it is not."""
    flux = np.load(kept.directory / "exposures" / "level-2.npy")
    panorama = np.nan_to_num(tifffile.imread(kept.directory / "panorama.tiff"))
    with np.load(kept.directory / "exposures" / "level-2.npz") as level, np.load(kept.directory / "trajectory.npz") as motion:
        assert level["scale"] == 1
        to_panorama = motion["canvas"] @ level["homographies"]

    def alike(index: int, place: int) -> float:
        back = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
        seen = cv2.warpPerspective(panorama, to_panorama[place], SHAPE[::-1], flags=back)
        smooth = [cv2.GaussianBlur(image, (0, 0), 1).ravel() for image in (seen, flux[index])]
        return float(np.corrcoef(*smooth)[0, 1])

    assert alike(3, 3) > 0.9
    assert alike(3, 3) > alike(3, 5) + 0.05


def test_resumed_run_writes_exposures_that_were_not_kept(small_spec: dict[str, Any], tmp_path: Path) -> None:
    def resumed(*overrides: str) -> RunResult:
        return photonpano.run(parse_spec(small_spec | {"levels": 1}, overrides=overrides, output=tmp_path / "run"), resume=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("photonpano.pipeline.run.render_report", lambda *_: "")
        resumed()
        assert not resumed("output.keep=exposures").was_finished
        assert (tmp_path / "run" / "exposures" / "level-1.npy").exists()
        assert resumed("output.keep=exposures").was_finished
        photonpano.run(parse_spec(small_spec | {"levels": 1}, output=tmp_path / "run"))
    assert not (tmp_path / "run" / "exposures").exists()
