import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, OutputError, StreamInfo
from photonpano.capture.writing import truth_path, write_packed
from photonpano.contracts.protocols import Closing
from photonpano.photometry import BinaryResponse


class RandomSource(Closing):
    """Frames that differ, each made from its index alone."""

    def __init__(self, n_frames: int, height: int, width: int, fails_at: int | None = None, kind: Any = "binary") -> None:
        self.info = StreamInfo(n_frames, height, width, None, kind)
        self.response = BinaryResponse()
        self.valid = np.ones((height, width), bool)
        self.fails_at = fails_at

    def frames(self, span: FrameSpan) -> np.ndarray:
        if self.fails_at is not None and span.stop > self.fails_at:
            raise InputError("the source has a flaw")
        return np.stack([self._frame(index) for index in range(span.start, span.stop)])

    def _frame(self, index: int) -> np.ndarray:
        return np.random.default_rng(index).integers(0, 2, self.info.frame_shape, dtype=np.uint8)

    def counts(self, span: FrameSpan) -> np.ndarray:
        return self.frames(span).sum(axis=0, dtype=np.uint32)


class TruthfulSource(RandomSource):
    def truth(self) -> dict[str, np.ndarray]:
        return {"homographies": np.tile(np.eye(3), (self.info.n_frames, 1, 1)), "frame_shape": np.array(self.info.frame_shape)}


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("photonpano.capture.writing._BLOCK_BYTES", 7 * 6 * 19)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_written_file_equals_the_frames(tmp_path: Path, threads: int) -> None:
    source, path, told = RandomSource(100, 6, 19), tmp_path / "cube.npy", []
    assert write_packed(source, path, told.append, threads) == (path,)
    packed = np.load(path, allow_pickle=False)
    assert (packed.shape, packed.dtype) == ((100, 6, 3), np.uint8)
    np.testing.assert_array_equal(np.unpackbits(packed, axis=-1, count=19), source.frames(FrameSpan(0, 100)))
    assert told == [7] * 14 + [2]
    assert list(tmp_path.iterdir()) == [path]


def test_truth_is_written_beside_the_capture(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy"
    assert write_packed(TruthfulSource(5, 6, 19), path) == (path, tmp_path / "cube.truth.npz")
    with np.load(truth_path(path), allow_pickle=False) as truth:
        assert sorted(truth) == ["frame_shape", "homographies"]
        assert truth["homographies"].shape == (5, 3, 3)


def interrupt(n_frames: int) -> None:
    raise KeyboardInterrupt


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("fails_at", "progress", "error"), [(50, None, InputError), (None, interrupt, KeyboardInterrupt)], ids=["flaw", "Ctrl-C"]
)
def test_failure_leaves_no_files(
    tmp_path: Path, fails_at: int | None, progress: Callable[[int], object] | None, error: type[BaseException]
) -> None:
    with pytest.raises(error):
        write_packed(TruthfulSource(100, 6, 19, fails_at), tmp_path / "cube.npy", progress)
    assert list(tmp_path.iterdir()) == []


_RUNS_OUT_OF_DISK = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from photonpano import OutputError, StreamInfo
from photonpano.capture.writing import write_packed

class Source:
    info, valid, response = StreamInfo(4000, 64, 64, None), np.ones((64, 64), bool), None
    def frames(self, span):
        return np.ones((len(span), 64, 64), np.uint8)
    def truth(self):
        return {"frame_shape": np.array([64, 64])}

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_200_000, 1_200_000))
try:
    write_packed(Source(), Path(sys.argv[1]))
except OutputError as error:
    print(error)
"""


def test_small_disk_is_reported_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(0, 0, 1_000_000_000))
    path = tmp_path / "cube.npy"
    with pytest.raises(OutputError) as caught:
        write_packed(RandomSource(100_000, 254, 496, fails_at=0), path)
    assert str(caught.value) == (
        f"cannot write {path}: it takes 1.47 GiB, and its disk has 954 MiB free; free some space or choose another folder"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("nowhere/cube.npy", "binary", "there is no folder {folder}/nowhere; create it or choose another"),
        ("cube", "binary", "a packed capture is a .npy file; name it cube.npy"),
        ("cube.npy", "intensity", "packed captures hold binary frames, and this source gives intensities"),
    ],
    ids=["folder", "suffix", "intensities"],
)
def test_what_cannot_be_written_is_refused_before_the_work(tmp_path: Path, name: str, kind: str, message: str) -> None:
    with pytest.raises((InputError, OutputError)) as caught:
        write_packed(RandomSource(5, 6, 19, fails_at=0, kind=kind), tmp_path / name)
    assert str(caught.value) == f"cannot write {tmp_path / name}: {message.format(folder=tmp_path)}"


class PackedRandomSource(RandomSource):
    """Would fail if its frames were asked for one by one."""

    def packed(self, span: FrameSpan) -> np.ndarray:
        return np.packbits(super().frames(span), axis=-1)

    def frames(self, span: FrameSpan) -> np.ndarray:
        raise AssertionError("frames are packed, and need not be unpacked")


def interrupted_after(n_frames: int, path: Path, source: RandomSource) -> None:
    """Write a capture so that it can be continued, and interrupt it after so many frames."""
    told: list[int] = []

    def count(n_written: int) -> None:
        told.append(n_written)
        if sum(told) >= n_frames:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_packed(source, path, count, resumed=told.append)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("kind", [RandomSource, PackedRandomSource])
@pytest.mark.parametrize("more", [b"", b"half a frame"])
def test_interrupted_file_is_continued(tmp_path: Path, kind: type[RandomSource], more: bytes) -> None:
    path, part = tmp_path / "cube.npy", tmp_path / "cube.npy.part"
    interrupted_after(30, path, kind(100, 6, 19))
    assert list(tmp_path.iterdir()) == [part]
    with part.open("ab") as file:
        file.write(more)
    found: list[int] = []
    told: list[int] = []
    write_packed(kind(100, 6, 19), path, told.append, resumed=found.append)
    assert list(tmp_path.iterdir()) == [path]
    assert found[0] >= 30
    assert told[0] == found[0]
    assert sum(told) == 100
    whole = tmp_path / "whole.npy"
    write_packed(kind(100, 6, 19), whole)
    assert path.read_bytes() == whole.read_bytes()


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("other", ["another shape", "another first frame", "no header"])
def test_partial_file_of_something_else_is_refused_and_kept(tmp_path: Path, other: str) -> None:
    path, part = tmp_path / "cube.npy", tmp_path / "cube.npy.part"
    interrupted_after(30, path, RandomSource(100, 7 if other == "another shape" else 6, 19))
    data = bytearray(part.read_bytes())
    data[{"another shape": 200, "another first frame": 128, "no header": 0}[other]] ^= 1
    part.write_bytes(data)
    with pytest.raises(OutputError) as caught:
        write_packed(RandomSource(100, 6, 19), path, resumed=lambda _: None)
    assert str(caught.value) == (
        f"cannot write {path}: {part} is there, and holds something else than the first frames of this capture; "
        "remove it, or choose another name"
    )
    assert part.read_bytes() == data


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(("first", "last"), [(1, 2), (17, 24), (29, 30)])
def test_partial_file_is_continued_from_its_first_damaged_frame(tmp_path: Path, first: int, last: int) -> None:
    path, part = tmp_path / "cube.npy", tmp_path / "cube.npy.part"
    interrupted_after(30, path, RandomSource(100, 6, 19))
    data, frame_bytes = bytearray(part.read_bytes()), 6 * 3
    data[128 + first * frame_bytes : 128 + last * frame_bytes] = bytes((last - first) * frame_bytes)
    part.write_bytes(data)
    found: list[int] = []
    write_packed(RandomSource(100, 6, 19), path, resumed=found.append)
    assert found == [first]
    np.testing.assert_array_equal(
        np.unpackbits(np.load(path), axis=-1, count=19), RandomSource(100, 6, 19).frames(FrameSpan(0, 100))
    )


@pytest.mark.parametrize("planted", ["cube.npy.part", "cube.npy"])
def test_symbolic_links_are_neither_followed_nor_replaced(tmp_path: Path, planted: str) -> None:
    (tmp_path / "precious").write_text("content")
    (tmp_path / planted).symlink_to("precious")
    with pytest.raises(OutputError) as caught:
        write_packed(RandomSource(20, 6, 19), tmp_path / "cube.npy", resumed=lambda _: None)
    what = {"cube.npy.part": f"{tmp_path}/cube.npy.part is no regular file", "cube.npy": "it is a symbolic link"}[planted]
    assert str(caught.value) == f"cannot write {tmp_path}/cube.npy: {what}; remove it, or choose another name"
    assert (tmp_path / "precious").read_text() == "content"
    assert (tmp_path / planted).is_symlink()


def test_partial_file_longer_than_the_capture_is_cut(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy"
    write_packed(RandomSource(20, 6, 19), path)
    whole = path.read_bytes()
    path.rename(tmp_path / "cube.npy.part").write_bytes(whole + b"more")
    found: list[int] = []
    write_packed(RandomSource(20, 6, 19), path, resumed=found.append)
    assert (found, path.read_bytes()) == ([20], whole)


def test_second_process_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy"

    def write_again(n_frames: int) -> None:
        write_packed(RandomSource(20, 6, 19), path, resumed=lambda _: None)

    with pytest.raises(OutputError) as caught:
        write_packed(RandomSource(20, 6, 19), path, write_again, resumed=lambda _: None)
    assert str(caught.value).startswith(f"{path} is in use: process {os.getpid()} on ")
    assert str(caught.value).endswith("; wait for it, or choose another name")


def test_full_disk_leaves_a_resumable_file(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy"
    script = _RUNS_OUT_OF_DISK.replace("Path(sys.argv[1])", "Path(sys.argv[1]), resumed=print")
    done = subprocess.run([sys.executable, "-c", script, path], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"cannot write {path}: File too large; ")
    assert [file.name for file in tmp_path.iterdir()] == ["cube.npy.part"]
    again = script.replace("(1_200_000, 1_200_000)", "(2**30, 2**30)")
    done = subprocess.run([sys.executable, "-c", again, path], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 2000
    assert np.load(path).shape == (4000, 64, 8)
    assert np.load(path).min() == 255
