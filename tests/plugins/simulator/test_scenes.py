from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from photonpano import InputError
from photonpano_simulator.config import NightScene, PhotoScene, StreetScene
from photonpano_simulator.scenes import scene_flux


def written(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def test_mean_of_the_scene_is_the_flux(photo: Path) -> None:
    for scene in (PhotoScene(file=photo), StreetScene(width=320, height=240), NightScene(width=320, height=240)):
        flux = scene_flux(scene, 0.3)
        assert flux.dtype == np.float32
        assert flux.mean(dtype=np.float64) == pytest.approx(0.3, rel=1e-5)
        assert flux.min() >= 0
    assert scene_flux(StreetScene(width=320, height=240), 0.3).shape == (240, 320)


@pytest.mark.parametrize("range_db", [60.0, 120.0])
def test_night_has_the_given_range_and_most_of_it_is_dark(range_db: float) -> None:
    flux = scene_flux(NightScene(width=320, height=240, range_db=range_db), 0.1)
    assert 20 * np.log10(flux.max() / flux.min()) == pytest.approx(range_db, abs=0.1)
    assert np.median(flux) < 1e-2 * flux.max()
    assert not np.array_equal(flux, scene_flux(NightScene(width=320, height=240, range_db=range_db, seed=1), 0.1))


@pytest.mark.parametrize(("bits", "step"), [(np.uint8, 1), (np.uint16, 257)])
def test_tone_curve_is_inverted(tmp_path: Path, bits: type, step: int) -> None:
    """The encoded grey 188 has 0.502886 of the light of white (IEC 61966-2-1)."""
    image = np.zeros((10, 30), bits)
    image[:, 10:20], image[:, 20:] = 188 * step, 255 * step
    flux = scene_flux(PhotoScene(file=written(tmp_path / "steps.png", image)), 1.502886 / 3)
    np.testing.assert_allclose(flux[0, [0, 10, 20]], [0, 0.502886, 1.0], rtol=1e-5)


def test_colours_are_converted_to_luminance(tmp_path: Path) -> None:
    image = np.zeros((10, 30, 3), np.uint8)
    for channel in range(3):
        image[:, 10 * channel : 10 * channel + 10, channel] = 255
    flux = scene_flux(PhotoScene(file=written(tmp_path / "bgr.png", image)), 1 / 3)
    np.testing.assert_allclose(flux[0, [0, 10, 20]], [0.0722, 0.7152, 0.2126], rtol=1e-4)


def test_photograph_is_resized(photo: Path) -> None:
    assert scene_flux(PhotoScene(file=photo), 1.0).shape == (150, 200)
    assert scene_flux(PhotoScene(file=photo, width=100), 1.0).shape == (75, 100)
    assert scene_flux(PhotoScene(file=photo, width=400), 1.0).shape == (300, 400)


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
    assert_refused(f"{wide} is 20000x1 px; set scene.width so that no side exceeds 16384 px", wide)
    floats = written(tmp_path / "floats.tiff", np.ones((9, 9, 3), np.float32))
    assert_refused(f"{floats} holds float32 values; a photograph has 8 or 16 bits: save it as PNG", floats)
