import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from scipy.ndimage import gaussian_filter

from photonpano import InputError
from photonpano.reading import frame_array, is_array_file, unpacked


def panned(n_frames: int, height: int = 24, width: int = 32) -> np.ndarray:
    """Return frames of zeros and ones that pan slowly over a scene, so that likeness shows which axis is that of the frames."""
    rng = np.random.default_rng(1)
    scene = np.exp(gaussian_filter(rng.standard_normal((height, width + n_frames // 10)), 2) * 8)
    looks = np.stack([scene[:, frame // 10 : frame // 10 + width] for frame in range(n_frames)])
    return (rng.random(looks.shape) < 1 - np.exp(-0.3 * looks)).astype(np.uint8)


BITS = panned(300)


def npz(path: Path, arrays: dict[str, Any]) -> Path:
    np.savez_compressed(path.with_suffix(".npz"), **arrays)
    return path.with_suffix(".npz")


def hdf5(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        for name, array in arrays.items():
            file[f"data/{name}"] = array
    return path.with_suffix(".h5")


def matlab(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    savemat(path.with_suffix(".mat"), arrays, do_compression=True)
    return path.with_suffix(".mat")


def matlab_73(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path.with_suffix(".mat"), "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = array.T
    with path.with_suffix(".mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")
    return path.with_suffix(".mat")


def first(frames: np.ndarray) -> np.ndarray:
    return frames


def last(frames: np.ndarray) -> np.ndarray:
    return np.moveaxis(frames, 0, -1)


WRITERS = [npz, hdf5, matlab, matlab_73]


@pytest.mark.parametrize(
    ("writer", "laid"), [(npz, first), (hdf5, first), (matlab, first), (matlab, last), (matlab_73, first), (matlab_73, last)]
)
def test_frames_are_those_that_were_written_wherever_their_axis_lies(writer: Any, laid: Any, tmp_path: Path) -> None:
    path = writer(tmp_path / "capture", {"frames": laid(BITS), "times": np.arange(3.0)})
    assert is_array_file(path)
    np.testing.assert_array_equal(np.load(unpacked(path)), BITS)


@pytest.mark.parametrize("writer", [matlab, matlab_73])
def test_written_axis_is_believed(writer: Any, tmp_path: Path) -> None:
    few = BITS[:20]
    path = writer(tmp_path / "capture", {"frames": last(few)})
    np.testing.assert_array_equal(np.load(unpacked(path, None, "last")), few)
    path = writer(tmp_path / "capture", {"frames": first(few)})
    np.testing.assert_array_equal(np.load(unpacked(path, None, "first")), few)


def test_few_frames_lie_last_in_files_of_matlab_and_first_in_others(tmp_path: Path) -> None:
    few = BITS[:20]
    np.testing.assert_array_equal(np.load(unpacked(matlab(tmp_path / "m", {"OUTPUT": last(few)}))), few)
    np.testing.assert_array_equal(np.load(unpacked(npz(tmp_path / "n", {"frames": few}))), few)


def test_colour_of_matlab_keeps_its_channels_last(tmp_path: Path) -> None:
    colour = np.random.default_rng(0).integers(0, 2, (5, 6, 7, 3), np.uint8)
    np.testing.assert_array_equal(np.load(unpacked(matlab(tmp_path / "m", {"c": last(colour)}))), colour)


def test_single_frame_of_matlab_has_lost_its_last_axis(tmp_path: Path) -> None:
    with frame_array(matlab(tmp_path / "m", {"OUTPUT": BITS[0]}), "OUTPUT") as array:
        assert array.shape(None) == (1, 24, 32)
        np.testing.assert_array_equal(next(array.blocks(None))[1], BITS[:1])


def test_whole_fractions_become_uint16_and_others_are_refused(tmp_path: Path) -> None:
    path = matlab(tmp_path / "m", {"OUTPUT": last(BITS).astype(np.float64)})
    assert np.load(unpacked(path)).dtype == np.uint16
    path = npz(tmp_path / "n", {"flux": BITS * 0.5})
    with pytest.raises(InputError, match="has an array flux of fractions, or of numbers outside of 0 to 65,535"):
        unpacked(path)
    assert {each.name for each in tmp_path.iterdir()} == {"m.mat", "m.mat.unpacked.OUTPUT.npy", "n.npz"}


@pytest.mark.parametrize("writer", WRITERS)
def test_name_is_asked_for_where_several_arrays_may_hold_frames(writer: Any, tmp_path: Path) -> None:
    path = writer(tmp_path / "capture", {"a": BITS, "b": BITS[:, ::-1].copy()})
    names = ("data/a", "data/b") if writer is hdf5 else ("a", "b")
    shown = r"\(300, 24, 32\)"
    with pytest.raises(
        InputError, match=rf"holds {names[0]} {shown} and {names[1]} {shown}; write array: {names[0]}, or another"
    ):
        unpacked(path)
    with pytest.raises(InputError, match=rf"has no array c, where frames are looked for: it holds {names[0]} {shown} and"):
        unpacked(path, "c", None)
    np.testing.assert_array_equal(np.load(unpacked(path, names[1], "first")), BITS[:, ::-1])


def test_array_is_unpacked_again_only_if_the_file_changed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    path = npz(tmp_path / "capture", {"frames": BITS})
    target = unpacked(path)
    assert unpacked(path) == target
    assert [each.message for each in caplog.records] == [f"{path} is unpacked to capture.npz.unpacked.frames.npy, once"]
    npz(tmp_path / "capture", {"frames": BITS[::-1]})
    os.utime(path, (0, 0))
    np.testing.assert_array_equal(np.load(unpacked(path)), BITS[::-1])


@pytest.mark.parametrize("writer", WRITERS)
def test_damaged_file_is_refused_in_a_sentence(writer: Any, tmp_path: Path) -> None:
    path = writer(tmp_path / "capture", {"frames": BITS})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError):
        unpacked(path)
