import importlib.util
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from photonpano import OutputError
from photonpano.record.picture_files import write_pictures

NAMES = ["frame_00", "frame_10", "frame_20"]


@pytest.fixture
def smooth() -> list[np.ndarray]:
    """Three pictures of an odd size, which get brighter."""
    y, x = np.mgrid[:41, :67]
    return [np.asarray(60 + 40 * k + 20 * np.sin(x / 9) + y / 3).astype(np.uint8) for k in range(3)]


def broken(pictures: list[np.ndarray]) -> Iterator[np.ndarray]:
    yield pictures[0]
    raise KeyboardInterrupt


def test_folder_gets_lossless_pngs(tmp_path: Path, smooth: list[np.ndarray]) -> None:
    write_pictures(tmp_path / "look", iter(smooth), NAMES, 24)
    assert [path.name for path in tmp_path.iterdir()] == ["look"]
    files = sorted((tmp_path / "look").iterdir())
    assert [file.stem for file in files] == NAMES
    for file, picture in zip(files, smooth, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), picture)


def test_mp4_has_even_sides_and_the_levels(tmp_path: Path, smooth: list[np.ndarray]) -> None:
    av = pytest.importorskip("av")
    write_pictures(tmp_path / "look.mp4", iter(smooth), NAMES, 12.5)
    with av.open(str(tmp_path / "look.mp4")) as film:
        frames = list(film.decode(video=0))
        assert film.streams.video[0].average_rate == 12.5
    assert [(frame.height, frame.width, frame.format.name) for frame in frames] == 3 * [(42, 68, "yuv420p")]
    for frame, picture in zip(frames, smooth, strict=True):
        shown = frame.to_ndarray(format="gray").astype(int)
        assert np.abs(shown[:41, :67] - picture).max() <= 6
        assert abs((shown[:41, :67] - picture).mean()) < 1
        np.testing.assert_allclose(shown[41], shown[40], atol=6)


@pytest.mark.parametrize(("name", "most"), [("look.webp", 6), ("look.gif", 2)])
def test_webp_and_gif_are_animated(tmp_path: Path, smooth: list[np.ndarray], name: str, most: int) -> None:
    write_pictures(tmp_path / name, iter(smooth), NAMES, 20)
    with Image.open(tmp_path / name) as film:
        assert (film.n_frames, film.size) == (3, (67, 41))
        for place, picture in enumerate(smooth):
            film.seek(place)
            film.load()
            assert film.info["duration"] == 50
            assert np.abs(np.asarray(film.convert("L")).astype(int) - picture).max() <= most


@pytest.mark.parametrize("name", ["look", "look.mp4", "look.webp", "look.gif"])
def test_interrupted_writing_leaves_no_files(tmp_path: Path, smooth: list[np.ndarray], name: str) -> None:
    if name.endswith("mp4"):
        pytest.importorskip("av")
    with pytest.raises(KeyboardInterrupt):
        write_pictures(tmp_path / name, broken(smooth), NAMES, 24)
    assert list(tmp_path.iterdir()) == []


def refused(path: Path, n_pictures: int = 3) -> str:
    with pytest.raises(OutputError) as caught:
        write_pictures(path, iter(()), ["x"] * n_pictures, 24)
    return str(caught.value).replace(f"{path.parent}/", "")


def test_pictures_replace_those_before_and_leave_other_files(tmp_path: Path, smooth: list[np.ndarray]) -> None:
    look = tmp_path / "look"
    write_pictures(look, iter(smooth), NAMES, 24)
    first, *others = (look / f"{name}.png" for name in NAMES)
    before = first.read_bytes()
    (look / "mine.png").touch()
    write_pictures(look, iter(smooth[1:2]), NAMES[:1], 24)
    assert first.read_bytes() != before
    assert sorted(look.iterdir()) == [first, look / "mine.png"]
    assert not any(path.exists() for path in others)


def test_wrong_names_are_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert refused(tmp_path / "look.avi") == (
        "cannot write look.avi: pictures go to a folder, as PNGs, or to a file that ends in .mp4, .webp or .gif"
    )
    assert refused(tmp_path / "look.webp", 501) == (
        "cannot write look.webp: 501 pictures are too many for an animated WebP, which holds 500; take fewer, or write an .mp4"
    )
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert refused(tmp_path / "look.mp4") == (
        'cannot write look.mp4: videos need av, which is not installed: pip install "photonpano[video]" '
        '(in a checkout: pip install ".[video]")'
    )
    assert refused(tmp_path / "no" / "look") == "cannot write look: there is no folder " + str(tmp_path / "no") + (
        "; create it or choose another"
    )
