"""The parts of a run that follows a capture."""

import errno
import os
import threading
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from photonpano import Arrived, FrameSpan, InputError, OutputError, Piped
from photonpano.geometry import rescaling, translation
from photonpano.pipeline.following import picture as picture_module
from photonpano.pipeline.following.arrivals import Arrivals, Delays, Spool
from photonpano.pipeline.following.located import Window
from photonpano.pipeline.following.picture import PictureSoFar
from photonpano.testing import KnownMotion, MemorySource


def source_of(frames: np.ndarray) -> MemorySource:
    return MemorySource(frames)


class TestDelays:
    def test_mean_quantile_and_longest(self) -> None:
        delays = Delays()
        assert (delays.mean, delays.quantile(0.95), delays.longest) == (None, None, None)
        delays.add(90, 0.1)
        delays.add(10, 0.5)
        assert delays.n_frames == 100
        assert delays.mean == pytest.approx(0.14)
        assert delays.quantile(0.5) == pytest.approx(0.11)
        assert delays.quantile(0.95) == delays.longest == 0.5

    def test_delays_of_hours_are_counted(self) -> None:
        delays = Delays()
        delays.add(1, 7200.0)
        assert (delays.longest, delays.quantile(0.95)) == (7200.0, 120.0)


class TestArrivals:
    def test_frames_wait_from_the_last_look_without_them(self) -> None:
        frames = np.zeros((9, 4, 8), np.uint8)
        there = [0]
        arrivals = Arrivals(lambda: Arrived(source_of(frames[: there[0]]) if there[0] else None, 9), None, 60.0)
        try:
            assert arrivals.source() is None
            before = time.monotonic()
            there[0] = 5
            arrivals.wait(5)
            assert arrivals.n_frames == 5
            now = before + 100
            assert arrivals.oldest(now) >= 100
            first, second = arrivals.waited(2, now), arrivals.waited(3, now)
            assert [n for n, _ in first + second] == [2, 1]
            assert all(100 <= seconds < 105 for _, seconds in first + second)
            there[0] = 9
            arrivals.wait(5)
            assert [n for n, _ in arrivals.waited(9, now)] == [2, 4]
            assert arrivals.oldest(now) == 0
            assert (arrivals.ended, arrivals.fell_silent) == (True, False)
        finally:
            arrivals.close()

    def test_failure_is_raised_in_the_thread_that_asks(self) -> None:
        def look() -> Arrived:
            raise InputError("broken")

        arrivals = Arrivals(look, lambda: True, 60.0)
        arrivals.wait(5)
        arrivals.close()
        assert arrivals.ended
        with pytest.raises(InputError, match="broken"):
            arrivals.source()

    def test_failure_that_passes_is_none(self) -> None:
        looks = [0]

        def look() -> Arrived:
            looks[0] += 1
            if looks[0] == 2:
                raise InputError("the file before is not complete yet")
            return Arrived(source_of(np.zeros((min(looks[0], 3), 4, 8), np.uint8)), 3)

        arrivals = Arrivals(look, None, 60.0)
        while not arrivals.ended:
            arrivals.wait(5)
        arrivals.close()
        assert (arrivals.source() is not None, arrivals.n_frames) == (True, 3)

    def test_times_of_arrival_do_not_fill_the_memory(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("photonpano.pipeline.following.arrivals._MOST_MARKS", 10)
        arrivals = Arrivals(lambda: Arrived(None), lambda: True, 60.0)
        arrivals.close()
        for number in range(1, 1000):
            arrivals._mark(number, float(number))
        assert len(arrivals._marks) <= 11
        waited = arrivals.waited(999, 1000.0)
        assert sum(n for n, _ in waited) == 999
        assert all(later <= earlier for (_, earlier), (_, later) in pairwise(waited))


class TestSpool:
    def test_header_stays_and_an_incomplete_frame_goes(self, tmp_path: Path) -> None:
        reading, writing = os.pipe()
        spool = Spool(reading, tmp_path / "a.raw", Piped(3, 4))
        os.write(writing, b"abc0123456789")
        os.close(writing)
        while not spool.ended:
            time.sleep(0.01)
        with pytest.raises(InputError, match="after 2 frames of 4 bytes came 2 bytes more"):
            spool.require_whole()
        spool.close()
        assert (tmp_path / "a.raw").read_bytes() == b"abc01234567"
        os.close(reading)

    def test_closed_spool_waits_for_no_writer(self, tmp_path: Path) -> None:
        reading, writing = os.pipe()
        spool = Spool(reading, tmp_path / "a.raw", Piped(0, 4))
        start = time.monotonic()
        spool.close()
        assert time.monotonic() - start < 2
        assert not (tmp_path / "a.raw").exists()
        assert "spool" not in [thread.name for thread in threading.enumerate()]
        os.close(writing)
        os.close(reading)

    def test_file_that_is_there_is_not_written(self, tmp_path: Path) -> None:
        (tmp_path / "a.raw").write_text("mine")
        with pytest.raises(OutputError, match=r"cannot write .*a\.raw: File exists"):
            Spool(0, tmp_path / "a.raw", Piped(0, 4))
        assert (tmp_path / "a.raw").read_text() == "mine"

    def test_full_disk_is_told_and_whole_frames_are_kept(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A disk with room for ten bytes of twelve."""
        write, room = os.write, [10]

        def filling(descriptor: int, data: bytes) -> int:
            if not room[0]:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            done = write(descriptor, data[: room[0]])
            room[0] -= done
            return done

        reading, writing = os.pipe()
        write(writing, b"0123456789ab")
        monkeypatch.setattr("photonpano.pipeline.following.arrivals.os.write", filling)
        path = tmp_path / "a.raw"
        spool = Spool(reading, path, Piped(0, 4))
        while not spool.ended:
            time.sleep(0.01)
        spool.close()
        with pytest.raises(OutputError) as caught:
            spool.require_whole()
        assert str(caught.value) == (
            f"cannot write {path}: No space left on device; the 2 whole frames are in {path}; make room"
        )
        assert path.read_bytes() == b"01234567"
        os.close(writing)
        os.close(reading)


class TestPicture:
    """Windows of one frame each, without noise, somewhere on a plane."""

    SHAPE = (30, 40)

    def scene(self) -> np.ndarray:
        noise = np.random.default_rng(0).random((200, 400)).astype(np.float32)
        smooth = cv2.GaussianBlur(noise, (0, 0), 6)
        return (smooth - smooth.min()) / (smooth.max() - smooth.min()) * 0.8 + 0.1

    def window(self, x: int, y: int, to_next: tuple[int, int], joins: bool = True, n_frames: int = 300) -> Window:
        """A window at (x, y) of the scene, which is also the place of the frame that it has in common with the last one."""
        height, width = self.SHAPE
        part = self.scene()[y : y + height, x : x + width]
        frames = (np.random.default_rng(x).random((n_frames, height, width)) < part).astype(np.uint8)
        still = KnownMotion(lambda _: np.eye(3))
        return Window(source_of(frames), FrameSpan(0, n_frames), still, joins, translation(*map(float, to_next)))

    def shown(self, picture: PictureSoFar) -> np.ndarray:
        png = picture.png()
        assert png is not None
        return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)

    def test_nothing_is_no_picture(self) -> None:
        assert PictureSoFar().png() is None

    @pytest.mark.parametrize(("most", "scale"), [(10**6, 1.0), (4000, 0.5), (1200, 0.25)])
    def test_windows_lie_side_by_side_at_any_scale(self, most: int, scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(picture_module, "_MOST_PIXELS", most)
        picture = PictureSoFar()
        for x in range(60, 181, 20):
            picture.add(self.window(x, 50, (20, 0), joins=x > 60))
        for x in range(200, 20, -20):  # back, and beyond the beginning
            picture.add(self.window(x, 50, (-20, 0)))
        assert picture.scale == scale
        seen = self.scene()[50:80, 40:240]
        flux = picture._flux()
        assert flux is not None
        expected = cv2.resize(-np.log1p(-seen), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        assert abs(flux.shape[1] - 200 * scale) <= 1
        middle = flux[2 : expected.shape[0] - 2, 2 : expected.shape[1] - 2]
        best = cv2.matchTemplate(expected, np.nan_to_num(middle), cv2.TM_CCOEFF_NORMED)
        assert best.max() > 0.95
        assert np.abs(np.array(np.unravel_index(best.argmax(), best.shape)) - [2, 2]).max() <= 1

    def test_tremor_within_a_window_is_not_cut_off(self) -> None:
        still = self.window(60, 50, (0, 0), joins=False, n_frames=101)
        trembling = KnownMotion(lambda frame: translation(10 * np.sin(2 * np.pi * frame / 50), 0))
        picture = PictureSoFar()
        picture.add(Window(still.source, still.new, trembling, False, np.eye(3)))
        height, width = self.SHAPE
        assert self.shown(picture).shape == (height, width + 20)

    def test_picture_begins_anew_where_windows_do_not_join(self) -> None:
        picture = PictureSoFar()
        picture.add(self.window(60, 50, (20, 0), joins=False))
        picture.add(self.window(80, 50, (20, 0)))
        assert self.shown(picture).shape == (30, 60)
        picture.add(self.window(80, 50, (20, 0), joins=False))
        assert self.shown(picture).shape == self.SHAPE

    @pytest.mark.parametrize("askew", [rescaling(3.0), np.array([[1, 0, 0], [0, 1, 0], [-0.03, 0, 1.0]])])
    def test_picture_begins_anew_where_frames_lie_too_askew(self, askew: np.ndarray) -> None:
        picture = PictureSoFar()
        first = self.window(60, 50, (0, 0), joins=False)
        picture.add(Window(first.source, first.new, first.trajectory, False, askew))
        picture.add(self.window(60, 50, (0, 0)))
        assert self.shown(picture).shape == self.SHAPE

    def test_picture_begins_anew_where_the_canvas_gets_too_large(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(picture_module, "_MOST_PIXELS", 2000)
        picture = PictureSoFar()
        picture.add(self.window(60, 50, (100_000, 0), joins=False))
        picture.add(self.window(80, 50, (0, 0)))
        assert (picture.scale, self.shown(picture).shape) == (1.0, self.SHAPE)
