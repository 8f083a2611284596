"""Lists of photons become frames; what a list lacks is named, and the motion of a telescope is its truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, KnowsTruth, SourceContext
from photonpano_sensors.event_lists import EVENTS, EventsConfig, EventsSource

FRAME, X, Y = np.array([3, 3, 3, 4, 6]), np.array([5, 6, 5, 5, 9]), np.array([2, 2, 2, 7, 4])


def opened(path: Path, **keys: Any) -> EventsSource:
    return EVENTS.build(EventsConfig(path=path, **keys), SourceContext())


def saved(folder: Path, **columns: Any) -> Path:
    """Write a list with frame, x and y, and these columns; None leaves one out."""
    found = {"frame": FRAME, "x": X, "y": Y} | columns
    np.savez(folder / "list.npz", **{name: each for name, each in found.items() if each is not None})
    return folder / "list.npz"


def csv(folder: Path) -> Path:
    (folder / "list.csv").write_text("x, y, frame\n" + "\n".join(f"{x},{y},{t}" for t, x, y in zip(FRAME, X, Y, strict=True)))
    return folder / "list.csv"


def rows(folder: Path) -> Path:
    np.save(folder / "list.npy", np.stack([FRAME, X, Y], axis=1))
    return folder / "list.npy"


def records(folder: Path) -> Path:
    array = np.rec.fromarrays([Y.astype("u2"), X.astype("u2"), FRAME.astype("u4")], names="row, col, frame_number")
    np.save(folder / "list.npy", np.asarray(array))
    return folder / "list.npy"


@pytest.mark.parametrize("write", [saved, csv, rows, records])
def test_photons_light_their_pixels_once_a_frame(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    with opened(write(tmp_path)) as source:
        assert (source.info.n_frames, source.info.frame_shape) == (4, (6, 5))  # from the first photon to the last
        frames = source.frames(source.info.span)
        assert [tuple(place) for place in np.argwhere(frames).tolist()] == [(0, 0, 0), (0, 0, 1), (1, 5, 0), (3, 2, 4)]
        assert source.counts(FrameSpan(0, 2)).sum() == 3


def test_times_are_divided_into_frames_and_pixels_into_larger_ones(tmp_path: Path) -> None:
    path = saved(tmp_path, frame=None, time=10 + 0.5 * FRAME)
    with opened(path, frame_duration=1.0, start=11, bin=2, frame_shape=(5, 6), frame_rate_hz=7) as source:
        assert (source.info.n_frames, source.info.frame_rate_hz) == (3, 7)
        places = [tuple(place) for place in np.argwhere(source.frames(source.info.span)).tolist()]
        assert places == [(0, 1, 2), (0, 1, 3), (1, 3, 2), (2, 2, 4)]


def test_chips_of_a_mosaic_lie_where_the_spec_puts_them(tmp_path: Path) -> None:
    columns = {"when": "frame", "x": "x", "y": "y", "chip": "ccd"}
    with opened(saved(tmp_path, ccd=[0, 0, 0, 1, 1]), columns=columns, chips={0: (0, 0), 1: (100, 0)}) as source:
        assert source.info.width == 109 - 5 + 1


def test_motion_of_a_telescope_is_the_truth(tmp_path: Path) -> None:
    """The sky is turned, mirrored and scaled against the sensor, and shifts from frame to frame."""
    rng = np.random.default_rng(0)
    frame = np.sort(rng.integers(0, 50, 4000))
    way = np.stack([np.sin(np.arange(50) / 8), np.arange(50) / 25], axis=1)
    pixels = rng.integers(0, 64, (4000, 2))
    sky = 900 + (pixels + rng.random((4000, 2)) + way[frame]) @ np.array([[0.3, 0.4], [0.4, -0.3]])
    columns = {"frame": frame, "detx": pixels[:, 0], "dety": pixels[:, 1], "x": sky[:, 0], "y": sky[:, 1]}
    with opened(saved(tmp_path, **columns)) as source:
        assert isinstance(source, KnowsTruth)
        shifts = source.truth()["homographies"][:, :2, 2]
    assert shifts[0].tolist() == [0, 0]
    assert np.abs(shifts - way + way[0]).mean() < 0.05


@pytest.mark.parametrize(
    ("columns", "keys", "message"),
    [
        ({"frame": FRAME[::-1]}, {}, "column 'frame' falls from 6 to 4 at row 1, from 0; sort the list by it"),
        ({"x": X + np.array([0, np.nan, 0, 0, 0])}, {}, "no number in column 'x' of row 1, from 0"),
        ({"x": X - 6}, {"frame_shape": (9, 9)}, "3 of 5 photons lie outside of the 9x9 px, the first at (-1, 2)"),
        ({"frame": 0.25 * FRAME}, {}, "column 'frame' has times, such as 0.75, not numbers of frames; write frame_duration"),
        ({"frame": FRAME * 10**9}, {}, "frames hold a photon; column 'frame' holds times: write a (longer) frame_duration"),
        (
            {"frame": None, "a": FRAME},
            {},
            "of the columns x, y, a, it is unknown which hold a photon's frame and pixel; write",
        ),
        ({"x": X[:3]}, {}, "has arrays of the shapes (5,), (3,), (5,); all columns have one length"),
        ({"x": np.stack([X, X])}, {}, "has arrays of the shapes (5,), (2, 5), (5,); all columns have one length"),
        ({"frame": [], "x": [], "y": []}, {}, "holds no photon"),
        ({"x": X * 10**6}, {}, "px; give frame_shape and origin, or a larger bin"),
        ({}, {"start": 8}, "no photon lies in the frames; correct start, n_frames or frame_duration"),
        ({}, {"columns": {"when": "frame", "x": "x", "y": "row"}}, "has no column 'row'; its columns are frame, x, y"),
        ({}, {"columns": {"when": "frame", "x": "x", "y": "y", "chip": "x"}}, "of the chips 5, 6, 9; `chips` lacks 5"),
    ],
)
def test_what_is_wrong_with_a_list_is_named(
    tmp_path: Path, columns: dict[str, Any], keys: dict[str, Any], message: str
) -> None:
    path = saved(tmp_path, **columns)
    [objection] = EVENTS.check(EventsConfig(path=path, **keys))
    assert objection.startswith(str(path))
    assert message in objection
    with pytest.raises(InputError):
        opened(path, **keys)


def test_photons_of_one_frame_may_come_in_any_order(tmp_path: Path) -> None:
    with opened(saved(tmp_path, frame=None, time=[3.4, 3.1, 3.9, 4.2, 6.0]), frame_duration=1.0) as source:
        lit = [tuple(place) for place in np.argwhere(source.frames(FrameSpan(0, 1))).tolist()]
        assert lit == [(0, 0, 0), (0, 0, 1)]


def test_lists_are_recognised_by_their_beginnings(tmp_path: Path) -> None:
    """A packed capture has the ending of a list, too, and may have terabytes."""
    np.lib.format.open_memmap(tmp_path / "cube.npy", "w+", np.uint8, (2**14, 1024, 1024)).flush()
    assert EVENTS.recognise(tmp_path / "cube.npy") is None
    np.lib.format.open_memmap(tmp_path / "list.npy", "w+", np.int64, (2**30, 3)).flush()
    found = EVENTS.recognise(tmp_path / "list.npy")
    assert found is not None
    assert found.because == "a list of photons: it holds rows of frame, x and y"


def test_field_of_a_csv_file_that_is_no_number_is_named(tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text("x,y,frame\n1,2,3\n1,,3\n")
    [objection] = EVENTS.check(EventsConfig(path=tmp_path / "list.csv"))
    assert objection.startswith(
        f"{tmp_path / 'list.csv'} is not a list of numbers: could not convert string '' to float64 at row 1"
    )


def test_picture_and_garbage_are_no_lists(tmp_path: Path) -> None:
    fits = pytest.importorskip("astropy.io.fits", reason="FITS needs photonpano[fits]")
    fits.PrimaryHDU(np.zeros((4, 5), np.float32)).writeto(tmp_path / "picture.fits")
    (tmp_path / "text.csv").write_text("one, two\nthree, four\n")
    for name, message in (
        ("picture.fits", "holds an image, and no table of photons"),
        ("text.csv", "it is unknown which hold a photon's frame"),
    ):
        assert EVENTS.recognise(tmp_path / name) is None
        with pytest.raises(InputError, match=message):
            opened(tmp_path / name)
