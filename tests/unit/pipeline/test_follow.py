"""Runs that follow a capture: same results as without, and errors with a way on."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import InputError, OutputError, RunResult, parse_spec, run


@pytest.fixture(scope="session")
def moving_frames(simulated: Callable[..., Path]) -> np.ndarray:
    """(300, 64, 12) packed frames of a camera that pans by 30 px."""
    return np.load(simulated(n_frames=300, frame_shape=[64, 96], path={"kind": "pan", "length_px": 30}, flux=0.5))


@pytest.fixture
def pipe_on_stdin() -> Iterator[Callable[..., None]]:
    """Let a thread write to standard input, and then close it."""
    threads: list[threading.Thread] = []
    before, (reading, writing) = os.dup(0), os.pipe()
    os.dup2(reading, 0)

    def begin(data: bytes, pieces: int = 1, seconds: float = 0.0) -> None:
        def write() -> None:
            size = -(-len(data) // pieces) or 1
            for start in range(0, len(data), size):
                os.write(writing, data[start : start + size])
                time.sleep(seconds / pieces)
            os.close(writing)

        threads.append(threading.Thread(target=write))
        threads[0].start()

    yield begin
    threads[0].join()
    os.dup2(before, 0)
    os.close(before)
    os.close(reading)


def spec(source: str = "packed-raw", **keys: Any) -> dict[str, Any]:
    """Return a small spec of frames of 64x96 px."""
    return {
        "version": 1,
        "source": {"use": source, "with": keys},
        "resample": {"with": {"group_size": 50}},
        "levels": 2,
        "refine": [],
    }


RESULTS = ("panorama.tiff", "coverage.tiff", "trajectory.npz", "panorama.png")
PIPED = spec(path="-", height=64, width=96)
POSES = {"pose": {"use": "colmap-averages"}, "resample": None, "levels": None, "refine": None}


def follow(document: dict[str, Any], output: Path, **options: Any) -> RunResult:
    return run(parse_spec(document, output=output, arriving=True), follow=True, **options)


def write_slowly(path: Path, frames: np.ndarray, n_frames: int, seconds: float) -> threading.Thread:
    """Write a .npy file of frames of which not all come."""

    def write() -> None:
        with path.open("wb", buffering=0) as file:
            header = {"descr": "|u1", "fortran_order": False, "shape": frames.shape}
            np.lib.format.write_array_header_1_0(file, header)
            for part in np.array_split(frames[:n_frames], 30):
                file.write(part.tobytes())
                time.sleep(seconds / 30)

    thread = threading.Thread(target=write)
    thread.start()
    return thread


@pytest.fixture(scope="module")
def grown(moving_frames: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, RunResult]:
    """A run that followed a file, and the run of the same file when it was complete."""
    folder = tmp_path_factory.mktemp("grown")
    document = spec("packed-npy", path=str(folder / "capture.npy"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("photonpano.pipeline.run.render_report", lambda *_: "<html></html>")
        writer = write_slowly(folder / "capture.npy", moving_frames, 300, 4.0)
        followed = follow(document, folder / "followed")
        writer.join()
        return followed, run(parse_spec(document, output=folder / "complete"))


def test_result_of_a_followed_capture_is_that_of_the_complete_one(grown: tuple[RunResult, RunResult]) -> None:
    followed, complete = grown
    for name in RESULTS:
        assert (followed.directory / name).read_bytes() == (complete.directory / name).read_bytes(), name


def test_page_shows_the_panorama_so_far_and_links_to_the_whole(grown: tuple[RunResult, RunResult]) -> None:
    followed, _ = grown
    folder = followed.directory.with_name("followed.live")
    assert {each.name for each in folder.iterdir()} == {"live.html", "live.json", "so-far"}
    figures = json.loads((folder / "live.json").read_text())
    assert (figures["state"], figures["frames"], figures["promised"], figures["message"]) == ("finished", 300, 300, "")
    assert 0 < figures["shown"] < 300
    page = (folder / "live.html").read_text()
    assert '<a href="../followed/report.html">' in page
    assert 'http-equiv="refresh"' not in page
    so_far, whole = (cv2.imread(str(each / "panorama.png"), 0) for each in (folder / "so-far", followed.directory))
    assert so_far is not None
    assert whole is not None
    assert so_far.shape[1] < whole.shape[1]
    best = cv2.matchTemplate(whole.astype(np.float32), so_far[8:-8, 8:-8].astype(np.float32), cv2.TM_CCOEFF_NORMED).max()
    assert best > 0.8


def test_frames_of_a_pipe_are_kept_and_give_the_same_result(
    moving_frames: np.ndarray, pipe_on_stdin: Callable[..., None], grown: tuple[RunResult, RunResult], tmp_path: Path
) -> None:
    pipe_on_stdin(moving_frames.tobytes(), 7, 0.3)  # pieces that end within frames
    result = follow(PIPED, tmp_path / "piped")
    kept = tmp_path / "piped.live" / "frames.raw"
    assert kept.read_bytes() == moving_frames.tobytes()
    assert result.record["spec"]["source"]["with"]["path"] == str(kept)
    for name in RESULTS:
        if name.endswith(".tiff"):  # the files have the names of their captures
            images = [tifffile.imread(each.directory / name) for each in (result, grown[1])]
            np.testing.assert_array_equal(*images)
        else:
            assert (result.directory / name).read_bytes() == (grown[1].directory / name).read_bytes(), name
    with pytest.raises(OutputError, match=r"frames\.raw holds the frames of an earlier capture: run them with source"):
        follow(PIPED, tmp_path / "piped")
    assert kept.stat().st_size == moving_frames.nbytes


def test_pipe_that_ends_within_a_frame(
    moving_frames: np.ndarray, pipe_on_stdin: Callable[..., None], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pipe_on_stdin(moving_frames[:120].tobytes()[:-68])
    kept = tmp_path / "piped.live" / "frames.raw"
    with caplog.at_level(logging.WARNING, "photonpano"), pytest.raises(InputError) as caught:
        follow(PIPED, tmp_path / "piped")
    assert str(caught.value) == (
        "standard input ended within a frame: after 119 frames of 768 bytes came 700 bytes more. Either the program that "
        f"writes has died, or height and width are wrong; the 119 whole frames are in {kept}"
    )
    assert caplog.messages[-1] == (
        f"the frames that arrived are in {kept}; run them with source.with.path = {str(kept)!r}, and without follow"
    )
    assert kept.read_bytes() == moving_frames[:119].tobytes()
    page = (tmp_path / "piped.live" / "live.html").read_text()
    assert "stopped" in page
    assert 'http-equiv="refresh"' not in page
    assert sorted(each.name for each in tmp_path.iterdir()) == ["piped.live"]
    assert "spool" not in [each.name for each in threading.enumerate()]


def test_interrupted_run_keeps_its_frames_and_says_how_to_go_on(moving_frames: np.ndarray, tmp_path: Path) -> None:
    (tmp_path / "pipe.yaml").write_text(json.dumps(PIPED))
    live, kept = tmp_path / "run.live" / "live.json", tmp_path / "run.live" / "frames.raw"
    command = [sys.executable, "-m", "photonpano", "run", "pipe.yaml", "--follow", "--output", "run"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    # Where the tests themselves run in the background of a shell, they ignore Ctrl-C, and so would what they start.
    heed = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    with subprocess.Popen(command, cwd=tmp_path, **pipes, **heed) as program:
        assert program.stdin is not None
        program.stdin.write(moving_frames[:110].tobytes() + b"part of a frame")
        program.stdin.flush()
        last = time.monotonic() + 60
        while not (live.exists() and json.loads(live.read_text())["frames"] == 110) and time.monotonic() < last:
            time.sleep(0.05)
        program.send_signal(signal.SIGINT)
        assert program.stderr is not None
        printed = program.stderr.read().decode()
        assert program.wait() == 130, printed
    way_on = f"photonpano run pipe.yaml --set source.with.path={kept} --output {tmp_path / 'run'}"
    assert f"warning: the frames that arrived are in {kept}; run them with `{way_on}`\n" in printed
    assert "interrupted; no file is left half-written" in printed
    assert kept.read_bytes() == moving_frames[:110].tobytes()
    assert json.loads(live.read_text())["state"] == "stopped"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["pipe.yaml", "run.live"]


def test_writer_that_dies_is_told_from_one_that_has_finished(moving_frames: np.ndarray, tmp_path: Path) -> None:
    writer = write_slowly(tmp_path / "capture.npy", moving_frames, 120, 0.0)
    with pytest.raises(InputError) as caught:
        follow(spec("packed-npy", path=str(tmp_path / "capture.npy")), tmp_path / "run", end_after=0.3)
    writer.join()
    assert str(caught.value) == (
        f"{tmp_path / 'capture.npy'} holds 120 of the 300 frames that it promises, and no more have come within 0.3 s: its "
        "writer has died, or pauses for longer. Then wait longer with --end-after. Otherwise record it again, or read the "
        "frames that are there with the source packed-raw and its key header_bytes"
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": {"use": "simulator"}}, "^source 'simulator' of .* cannot read a capture that is still being written"),
        (POSES, "^a spec with 'pose' cannot be followed"),
        ({"source": {"use": "packed-raw", "with": PIPED["source"]["with"] | {"frames": [0, 5]}}}, "a part of a capture cannot"),
    ],
)
def test_what_cannot_be_followed_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    document = {key: value for key, value in (PIPED | changes).items() if value is not None}
    with pytest.raises(InputError, match=message):
        follow(document, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []
