"""The program photoncube reads the same bits out of the same files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photonpano import PackedSource, SourceContext, discover


@pytest.mark.parametrize(("name", "shape"), [("swissspad-half", (256, 512)), ("swissspad-full", (512, 512))])
def test_frames_equal_those_of_photoncube(tmp_path: Path, bin_file: Callable, name: str, shape: tuple[int, int]) -> None:
    photoncube = pytest.importorskip("photoncube")
    folder, converted = tmp_path / "bins", tmp_path / "cube.npy"
    folder.mkdir()
    n_frames = 512 * 256 // shape[0]  # of a file: it takes no others
    for number in (2, 10):
        rows = np.random.default_rng(number).integers(0, 2, (n_frames, 1, shape[1]), dtype=np.uint8)
        frames = np.repeat(rows, shape[0], axis=1) ^ (np.arange(shape[0]) % 7 == 0).astype(np.uint8)[:, None]
        (folder / f"filename{number}.bin").write_bytes(bin_file(name, frames))
    photoncube.PhotonCube.convert_to_npy(str(folder), str(converted), is_full_array=name.endswith("full"))
    contribution = discover().find("source", name).contribution
    with contribution.build(contribution.config(path=folder), SourceContext()) as source:
        assert isinstance(source, PackedSource)
        assert np.array_equal(source.packed(source.info.span), np.load(converted))
