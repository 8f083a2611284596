"""A capture behind a Bayer array becomes a panorama, a picture, a report and a score in colour."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import InputError, SpecError, evaluate, parse_spec, preview, run
from photonpano.capture.writing import truth_path
from photonpano.pipeline.run import RunResult


@pytest.fixture(scope="module")
def capture(simulated: Callable[..., Path]) -> Path:
    return simulated(sensor={"filters": "rggb"}, flux=1.5)


@pytest.fixture(scope="module")
def spec(capture: Path) -> dict[str, Any]:
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(capture)}},
        "corrections": [{"colour-filter": {"pattern": "rggb", "keep": "all"}}],
        "resample": {"with": {"group_size": 50}},
        "render": {"white_balance": [1, 1, 0.001]},
    }


@pytest.fixture(scope="module")
def coloured(spec: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return run(parse_spec(spec, output=tmp_path_factory.mktemp("runs") / "colour"))


def test_panorama_and_coverage_have_three_colours(coloured: RunResult) -> None:
    flux, coverage = (tifffile.imread(coloured.directory / f"{name}.tiff") for name in ("panorama", "coverage"))
    canvas = coloured.record["panorama"]
    assert flux.shape == coverage.shape == (canvas["height"], canvas["width"], 3)
    assert flux.dtype == coverage.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(flux).any(axis=-1), (coverage == 0).all(axis=-1))
    assert coverage[..., 1].sum() == pytest.approx(2 * coverage[..., 0].sum(), rel=0.02)
    assert coloured.record["panorama"]["coverage_share"] > 0.5


def test_picture_is_in_colour_and_balanced(coloured: RunResult) -> None:
    flux = tifffile.imread(coloured.directory / "panorama.tiff")
    picture = cv2.imread(str(coloured.directory / "panorama.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (*flux.shape[:2], 4)
    np.testing.assert_array_equal(picture[..., 3] > 0, ~np.isnan(flux).all(axis=-1))
    picture = picture[..., :3]
    assert picture[..., 0].mean() < 0.1 * picture[..., 2].mean()  # blue first
    assert np.nanmean(flux[..., 2]) > 0.5 * np.nanmean(flux[..., 0])
    assert "<img" in (coloured.directory / "report.html").read_text(encoding="utf-8")


def test_white_balance_of_a_grey_capture_is_refused(spec: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(SpecError) as caught:
        run(parse_spec({**spec, "corrections": []}, output=tmp_path / "grey"))
    assert str(caught.value) == (
        "render.white_balance: the capture is grey; remove this key, or name the colour filter: "
        "corrections: [{colour-filter: {...}}]"
    )
    assert not (tmp_path / "grey").exists()


def test_motion_is_that_of_a_grey_capture_and_the_panorama_near_the_oracle(coloured: RunResult, capture: Path) -> None:
    scores = evaluate(coloured.directory, truth_path(capture), oracle=True)
    assert scores.trajectory.errors_px.mean() < 0.15
    assert scores.below_oracle_db is not None
    assert scores.below_oracle_db < 0.5
    assert coloured.verdict.status == "trusted"


def test_scene_in_colour_is_no_truth_of_a_grey_panorama(
    small_run: RunResult, coloured: RunResult, small_capture: Path, capture: Path
) -> None:
    with pytest.raises(InputError, match=r"the panorama is grey, and the true scene of .* is in colour$"):
        evaluate(small_run.directory, truth_path(capture))
    with pytest.raises(InputError, match=r"the panorama is in colour, and the true scene of .* is grey$"):
        evaluate(coloured.directory, truth_path(small_capture))


@pytest.mark.parametrize("name", ["pictures", "film.webp"])
def test_preview_is_in_colour(spec: dict[str, Any], tmp_path: Path, name: str) -> None:
    preview(parse_spec(spec), tmp_path / name, 100, label=True)
    if name == "pictures":
        picture = cv2.imread(str(next((tmp_path / name).iterdir())), cv2.IMREAD_UNCHANGED)
        assert picture.shape == (128 + 14, 160, 3)
        assert picture[:128].std(axis=-1).mean() > 10
