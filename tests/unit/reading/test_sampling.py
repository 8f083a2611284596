from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from photonpano.reading import npy_header, sampled_frames, sampled_spans


def test_short_capture_is_sampled_whole() -> None:
    assert [(span.start, span.stop) for span in sampled_spans(100, 64)] == [(0, 100)]


def test_long_capture_is_sampled_from_start_to_end_within_its_budget() -> None:
    spans = sampled_spans(100_000, 254 * 62)
    assert spans[0].start == 0
    assert len(spans) == 1 or spans[-1].stop == 100_000
    assert sum(map(len, spans)) * 254 * 62 <= 3 * 1024**2


def test_large_frames_are_sampled_by_their_first_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("photonpano.reading.guessed_layout._VALUES", 16 * 8 * 5)
    frames = np.random.default_rng(0).integers(0, 256, (50, 8, 40), np.uint8)
    np.save(tmp_path / "cube.npy", frames)
    (found,) = sampled_frames(tmp_path / "cube.npy", npy_header(tmp_path / "cube.npy"))
    np.testing.assert_array_equal(found, frames[:16, :, :5])


def test_compressed_capture_is_sampled_from_its_beginning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("photonpano.reading.guessed_layout._VALUES", 1000)
    frames = np.random.default_rng(0).integers(0, 2**16, (50, 8, 40), np.uint16)
    np.save(tmp_path / "cube.npy", frames)
    header = npy_header(tmp_path / "cube.npy")
    (tmp_path / "cube.npy.gz").write_bytes(gzip.compress((tmp_path / "cube.npy").read_bytes()))
    (found,) = sampled_frames(tmp_path / "cube.npy.gz", header)
    np.testing.assert_array_equal(found, frames[:3])


def test_file_that_is_cut_short_is_not_sampled(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.zeros((50, 8, 40), np.uint8))
    header = npy_header(tmp_path / "cube.npy")
    (tmp_path / "cube.npy").write_bytes((tmp_path / "cube.npy").read_bytes()[:-1])
    assert sampled_frames(tmp_path / "cube.npy", header) == []
