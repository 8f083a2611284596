"""Videos of a finished run: every format has its pictures, and wrong input is named before anything is written."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from photonpano import video
from photonpano.pipeline.run import RunResult

BOX = "render.extent=[10, 20, 90, 80]"


@pytest.mark.parametrize("name", ["film.webp", "film.gif", "film.mp4", "film"])
def test_video_has_its_pictures_in_every_format(small_run: RunResult, tmp_path: Path, name: str) -> None:
    made = video(small_run.directory, tmp_path / name, exposure=60, changes=[BOX])
    assert (made.n_pictures, made.shape, made.exposure, made.step) == (5, (60, 80), 60, 60)
    assert made.speed == pytest.approx(60 * 25 / 96_800)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    if name == "film":
        files = sorted((tmp_path / name).iterdir())
        assert [file.name for file in files] == [f"frame_{number}.png" for number in range(5)]
        shapes = {
            (picture.shape, picture.dtype.name) for picture in (cv2.imread(str(each), cv2.IMREAD_UNCHANGED) for each in files)
        }
        assert shapes == {((60, 80), "uint16")}
    elif name == "film.mp4":
        av = pytest.importorskip("av")
        with av.open(str(tmp_path / name)) as film:
            assert [(each.height, each.width) for each in film.decode(video=0)] == 5 * [(60, 80)]
    else:
        with Image.open(tmp_path / name) as film:
            assert (film.n_frames, film.size) == (5, (80, 60))


def pictures(folder: Path) -> np.ndarray:
    return np.stack([cv2.imread(str(each), cv2.IMREAD_UNCHANGED) for each in sorted(folder.iterdir())]) / 65535.0


def test_still_things_stand_still(small_run: RunResult, tmp_path: Path) -> None:
    video(small_run.directory, tmp_path / "film", exposure="1ms", speed=0.01, changes=[BOX])
    shown = pictures(tmp_path / "film")
    assert len(shown) == 6  # 97 of 300 frames each, 38.7 apart
    assert cv2.phaseCorrelate(shown[0], shown[-1])[0] == pytest.approx((0, 0), abs=0.15)


def test_smooth_view_follows_the_camera(small_run: RunResult, tmp_path: Path) -> None:
    video(small_run.directory, tmp_path / "film", view="smooth", exposure=50, changes=["render.extent=[20, 20, 140, 108]"])
    shown = pictures(tmp_path / "film")
    steps = [cv2.phaseCorrelate(*pair)[0] for pair in pairwise(shown)]
    # The camera pans by 60 px at 10 degrees in 300 frames, and trembles by 3 px.
    np.testing.assert_allclose(steps, np.broadcast_to([-10 * np.cos(np.pi / 18), -10 * np.sin(np.pi / 18)], (5, 2)), atol=2)
    assert np.std(steps, axis=0).max() < 1


def test_trail_shows_the_panorama_around_the_frame(small_run: RunResult, tmp_path: Path) -> None:
    video(small_run.directory, tmp_path / "film", exposure=50, speed=0.05)
    video(small_run.directory, tmp_path / "trail", exposure=50, speed=0.05, trail=True)
    plain, trail = pictures(tmp_path / "film")[0], pictures(tmp_path / "trail")[0]
    assert (plain == 0).mean() > 0.15
    assert (trail == 0).mean() < 0.05
    assert (trail > 0.7).sum() > (plain > 0.7).sum() + 200
