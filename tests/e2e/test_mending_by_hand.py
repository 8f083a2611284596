"""A capture that nothing ties together, mended by clicks in the report of the run that failed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import LocationError, load_trajectory, parse_spec, run
from photonpano.geometry import corners, inverse, transform_points, translation
from photonpano.testing.captures import detected, seen_along, textured
from photonpano.values import FloatArray

SHAPE, N_FRAMES, WALL = (72, 112), 640, (200, 440)


def _to_scene(frame: float) -> FloatArray:
    """Return the motion of a frame: the camera drifts, and is elsewhere after a wall has passed."""
    return translation(4 + 0.075 * frame + (50 if frame >= N_FRAMES // 2 else 0), 14 + 10 * math.sin(frame / 80))


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A capture whose middle shows a wall without texture."""
    scene = cv2.GaussianBlur(textured((100, 220), 0.5, 0.8, 3), (0, 0), 1.5)
    frames = detected(seen_along(scene, np.stack([_to_scene(frame) for frame in range(N_FRAMES)]), SHAPE), 1)
    frames[slice(*WALL)] = np.random.default_rng(0).random((WALL[1] - WALL[0], *SHAPE)) < 0.4
    path = tmp_path_factory.mktemp("mended") / "capture.npy"
    np.save(path, np.packbits(frames, axis=-1))
    source = {"use": "packed-npy", "with": {"path": str(path)}}
    return {
        "version": 1,
        "source": source,
        "levels": 1,
        "refine": [],
        "light": "steady",
        "resample": {"with": {"group_size": 40}},
        "corrections": [],
    }


def _errors_px(folder: Path, frames: range, reference: int) -> FloatArray:
    """Return the mean error of the corners of some frames, beside one frame."""
    homographies = load_trajectory(folder).homographies[[reference, *frames]]
    truth = np.array([inverse(_to_scene(reference)) @ _to_scene(frame) for frame in frames])
    found = inverse(homographies[0]) @ homographies[1:]
    away = transform_points(found, corners(SHAPE)) - transform_points(truth, corners(SHAPE))
    return np.linalg.norm(away, axis=-1).mean(axis=-1)


def _click(page: Any, label: str, frame: int, point: FloatArray) -> None:
    """Choose the picture around a frame, and click a point of the frame in it."""
    chosen = f"""(() => {{
      const select = document.querySelector('select[aria-label="{label}"]');
      const option = [...select.options].find((each) => each.textContent === "around frame {frame:,}");
      select.value = option.value;
      select.dispatchEvent(new Event("change"));
      const image = document.querySelector('img[alt="{label}"]');
      return image.decode().then(() => {{
        image.scrollIntoView({{block: "center"}});
        const {{x, y, width, height}} = image.getBoundingClientRect();
        return [x, y, width, height];
      }});
    }})()"""
    left, top, width, height = page.run(chosen)
    x, y = left + (point[0] + 0.5) / SHAPE[1] * width, top + (point[1] + 0.5) / SHAPE[0] * height
    for kind in ("mousePressed", "mouseReleased"):
        page.mouse(kind, x, y, button="left", clickCount=1)


def test_places_that_were_clicked_tie_parts_together(spec: dict[str, Any], browser_page: Any, tmp_path: Path) -> None:
    with pytest.raises(LocationError, match="cannot be tied to the rest"):
        run(parse_spec(spec, output=tmp_path / "run"))
    browser_page.open(tmp_path / "run.failed.html")
    browser_page.run('document.querySelector("#ties").open = true')
    frames = 179, 459
    for point in np.array([[30.0, 40.0], [20.0, 70.0]]):
        there = transform_points(inverse(_to_scene(frames[0])) @ _to_scene(frames[1]), point[None])[0]
        _click(browser_page, "Frame on the left", frames[0], there)
        _click(browser_page, "Frame on the right", frames[1], point)
    (tmp_path / "ties.csv").write_text(browser_page.run('document.querySelector("#ties pre").textContent'))
    assert (browser_page.messages, browser_page.requests) == ([], [])

    tied = spec | {"graph": {"tie": str(tmp_path / "ties.csv"), "disconnected": "largest"}}
    run(parse_spec(tied, output=tmp_path / "tied"))
    for part in (range(WALL[0]), range(WALL[1], N_FRAMES)):
        assert _errors_px(tmp_path / "tied", part, 100).mean() < 0.3
