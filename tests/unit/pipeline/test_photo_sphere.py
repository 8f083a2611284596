"""Tests of the metadata by which viewers open a spherical panorama."""

import re

import cv2
import numpy as np
import pytest

from photonpano.geometry import Camera, Canvas, canvas_around, covered_by, rotation_matrices
from photonpano.pipeline.photo_sphere import photo_sphere, with_xmp

SHAPE = (40, 60)
CAMERA = Camera.of(50.0, SHAPE)


def spherical(first: float, last: float) -> Canvas:
    yaws = np.radians(np.arange(first, last + 1, 5))
    turns = rotation_matrices(np.stack([0 * yaws, yaws, 0 * yaws], axis=-1))
    return canvas_around(covered_by(turns, CAMERA, SHAPE), CAMERA, 1.0, "spherical")


def numbers(packet: str) -> dict[str, int]:
    return {name: int(value) for name, value in re.findall(r"<GPano:(\w+Pixels)>(\d+)<", packet)}


def test_full_turn_has_the_width_of_the_sphere() -> None:
    canvas = spherical(0, 360)
    found = numbers(photo_sphere(canvas, canvas.shape) or "")
    assert found["FullPanoWidthPixels"] == found["CroppedAreaImageWidthPixels"] == canvas.width == 316
    assert found["FullPanoHeightPixels"] == 158
    assert found["CroppedAreaLeftPixels"] == 0
    # The horizon, b = 0, is the middle of the sphere.
    assert found["CroppedAreaTopPixels"] + canvas.transform[1, 2] == pytest.approx(158 / 2 - 0.5, abs=0.51)


def test_part_of_a_turn_lies_where_it_looks() -> None:
    canvas = spherical(0, 60)
    found = numbers(photo_sphere(canvas, canvas.shape) or "")
    assert found["CroppedAreaLeftPixels"] + canvas.transform[0, 2] == pytest.approx(314 / 2 - 0.5, abs=0.51)


def test_smaller_picture_has_numbers_of_its_own_pixels() -> None:
    canvas = spherical(0, 360)
    found = numbers(photo_sphere(canvas, (canvas.height // 2, canvas.width // 2)) or "")
    assert (found["FullPanoWidthPixels"], found["FullPanoHeightPixels"]) == (158, 79)


def test_other_projections_have_no_metadata() -> None:
    assert photo_sphere(Canvas(40, 60, np.eye(3)), SHAPE) is None


def test_pixels_of_png_stay_as_they_are() -> None:
    image = np.random.default_rng(0).integers(0, 255, SHAPE, np.uint8)
    png = cv2.imencode(".png", image)[1].tobytes()
    marked = with_xmp(png, "<x:xmpmeta/>")
    assert np.array_equal(cv2.imdecode(np.frombuffer(marked, np.uint8), cv2.IMREAD_UNCHANGED), image)
    assert marked.replace(marked[33 : 33 + len(marked) - len(png)], b"") == png
