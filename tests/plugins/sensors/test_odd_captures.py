"""Captures that are odd, and not wrong; those that are wrong stand in `tests/plugins/captures`."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from photonpano import FrameSpan, InputError, Source, SourceContext, discover

CATALOG = discover()


def opened(name: str, path: Path) -> Source:
    contribution = CATALOG.find("source", name).contribution
    return contribution.build(contribution.config(path=path), SourceContext())


def test_sparse_addresses_may_be_unordered_and_repeated(tmp_path: Path) -> None:
    path = tmp_path / "sparse.bin"
    path.write_bytes(np.array([700, 5, 700, 262144, 262144, 5, 262144], "<u4").tobytes())
    with opened("spad512-sparse", path) as source:
        counts = source.counts(FrameSpan(0, 3))
        assert (counts[0, 5], counts[1, 700 - 512], counts.sum()) == (2, 1, 3)
        np.testing.assert_array_equal(source.frames(FrameSpan(0, 3)).sum(axis=0), counts)


def test_file_that_shrinks_while_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frames.bin"
    path.write_bytes(bytes(10 * 16384))
    with opened("swissspad-half", path) as source:
        os.truncate(path, 5 * 16384)
        assert not source.counts(FrameSpan(0, 5)).any()
        with pytest.raises(InputError) as caught:
            source.counts(FrameSpan(0, 6))
    assert str(caught.value) == f"{path} has become shorter while it was read; copy or record it again"


@pytest.mark.parametrize("n_frames", [18, 6])
def test_info_json_counts_frames_of_the_capture_or_of_a_part(tmp_path: Path, n_frames: int) -> None:
    for number in (1, 2, 3):
        savemat(tmp_path / f"part_{number}.mat", {"OUTPUT": np.zeros((10, 16, 6), np.uint8)})
    (tmp_path / "info.json").write_text(json.dumps({"no_parts": 3, "no_frames": n_frames}))
    with opened("mat-parts", tmp_path) as source:
        assert source.info.n_frames == 18
