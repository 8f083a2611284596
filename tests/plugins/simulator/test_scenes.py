"""Scenes: photographs, the street by day and at night, and the files that describe what is drawn."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import InputError
from photonpano_simulator import scenes, travel_stage
from photonpano_simulator.config import NightScene, PhotoScene, StreetScene
from photonpano_simulator.scenes import Chance, Drawing, pictures_of, read_scene, scene_flux


def written(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def test_mean_of_the_scene_is_the_flux(photo: Path) -> None:
    scenes = (
        PhotoScene(file=photo),
        StreetScene(width=320, height=240),
        *(NightScene(width=320, height=240, seed=seed) for seed in (0, 1)),
    )
    drawn = [scene_flux(scene, 0.3) for scene in scenes]
    for flux in drawn:
        assert flux.dtype == np.float32
        assert flux.mean(dtype=np.float64) == pytest.approx(0.3, rel=1e-5)
        assert flux.min() >= 0
    assert drawn[1].shape == (240, 320)
    assert not np.array_equal(drawn[2], drawn[3])


@pytest.mark.parametrize("range_db", [60.0, 120.0])
def test_night_has_the_given_range_and_most_of_it_is_dark(range_db: float) -> None:
    flux = scene_flux(NightScene(width=320, height=240, range_db=range_db), 0.1)
    assert 20 * np.log10(flux.max() / flux.min()) == pytest.approx(range_db, abs=0.1)
    assert np.median(flux) < 1e-2 * flux.max()


def test_colours_are_converted_to_luminance(tmp_path: Path) -> None:
    image = np.zeros((10, 30, 3), np.uint8)
    for channel in range(3):
        image[:, 10 * channel : 10 * channel + 10, channel] = 255
    flux = scene_flux(PhotoScene(file=written(tmp_path / "bgr.png", image)), 1 / 3)
    np.testing.assert_allclose(flux[0, [0, 10, 20]], [0.0722, 0.7152, 0.2126], rtol=1e-4)


def assert_refused(message: str, path: Path) -> None:
    with pytest.raises(InputError) as caught:
        scene_flux(PhotoScene(file=path), 1.0)
    assert str(caught.value) == message


def test_wrong_photographs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    assert_refused(f"there is no file {path}; check the path", path)
    assert_refused(f"cannot read {tmp_path}: Is a directory", tmp_path)
    for content in (b"", b"no image"):
        path.write_bytes(content)
        assert_refused(f"{path} is not an image that OpenCV reads; save it as PNG or JPEG", path)
    written(path, np.zeros((9, 9), np.uint8))
    assert_refused(f"{path} is black: no flux can be made of it; take another photograph", path)
    wide = written(tmp_path / "wide.png", np.ones((1, 20_000), np.uint8))
    assert_refused(f"{wide} is 1x20000 px; set scene.width so that no side exceeds 16384 px", wide)
    floats = written(tmp_path / "floats.tiff", np.ones((9, 9, 3), np.float32))
    assert_refused(f"{floats} holds float32 values; a photograph has 8 or 16 bits: save it as PNG", floats)


def documented(module: ModuleType) -> set[str]:
    """Return the keys that the description of a module explains."""
    keys = re.findall(r"^    ([a-z, ]+):", module.__doc__, re.MULTILINE)
    return set(re.findall(r"[a-z]+", " ".join([*keys, *re.findall(r"`[a-z]+`", module.__doc__)])))


def marks_of(picture: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the marks of a picture, and those in them."""
    for mark in picture:
        yield mark
        draw = mark.get("draw")
        if isinstance(draw, list) and draw and isinstance(draw[0], dict):
            yield from marks_of(draw)


def names_in(value: Any) -> Iterator[str]:
    """Yield what a mapping of picked values may stand for."""
    if isinstance(value, dict):
        for each in value.values():
            yield from names_in(each)
    elif isinstance(value, list):
        for each in value:
            yield from names_in(each)
    else:
        yield str(value)


@pytest.mark.parametrize("kind", ["street", "room", "facade", "planes"])
def test_files_of_scenes_have_no_unknown_key_or_picture(kind: str) -> None:
    pictures, scene = pictures_of(kind), read_scene(kind)
    marks = [mark for picture in pictures.values() for mark in marks_of(picture)]
    things = [*scene.get("things", []), *(thing for group in scene.get("groups", {}).values() for thing in group)]
    picked = {name for mark in marks for value in mark.get("pick", {}).values() for name in names_in(value)}
    variables = {"opening", "beside", "below", "surface", "goods"}
    drawn = {"street", *picked}
    for keys, entries in ((documented(scenes), marks), (documented(travel_stage), things)):
        for entry in entries:
            assert set(entry) <= keys, entry
            for key in ("draw", "front", "top"):
                names = entry.get(key, [])
                drawn |= {name for name in ([names] if isinstance(names, str) else names) if isinstance(name, str)}
    assert drawn - variables - picked <= set(pictures)


def test_numbers_of_scenes_are_shares_names_and_draws() -> None:
    chance, names = Chance(np.random.default_rng(0)), {"wall": 0.5, "left": "100%-10"}
    written = {3: 3, "25%": 50, "100%-20": 180, "wall*0.5": 0.25, "left": 190, "left-4": 186}
    assert {each: chance.number(each, names, 200) for each in written} == written
    between = [chance.number([2, "wall*6"], names) for _ in range(200)]
    assert 2 <= min(between) < 2.1 < 2.9 < max(between) <= 3
    deck = [1, 2, 3, 4]
    assert sorted(chance.number(deck, names) for _ in range(8)) == [1, 1, 2, 2, 3, 3, 4, 4]
    assert chance.picked(names, {"signs": [{"ink": 0.1, "paper": 0.9}]}) == names | {"ink": 0.1, "paper": 0.9}
    with pytest.raises(ValueError, match="'3 px' is no number of a scene"):
        chance.number("3 px", names)


@pytest.mark.parametrize(
    ("mark", "share"),
    [
        ({"box": [10, "50%", "25%", 5], "tone": 1}, 0.125),
        ({"up": [0, 0, "100%", 5], "tone": 1}, 0.5),
        ({"shape": "disc", "tone": 1}, np.pi / 4),
        ({"shape": [[0, 0], [1, 0], [0, 1]], "tone": 1}, 0.5),
        ({"cells": [10, 0], "draw": [{"box": [0, 0, "40%", "100%"], "tone": 1}]}, 0.4),
        ({"tone": 0, "to": 1}, 0.5),
        ({"draw": [{"tone": 1}, {"shade": 0.3}]}, 0.3),
        ({"bricks": [4, 2], "tone": 0.8, "spread": 0, "joint": 0.8}, 0.8),
        ({"chance": 0, "tone": 1}, 0.0),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_marks_cover_their_shares(mark: dict[str, Any], share: float) -> None:
    drawn = Drawing((80, 160), 10, {"all": [mark]}, np.random.default_rng(0)).finished("all", {})
    assert drawn.mean() == pytest.approx(share, abs=0.012)
