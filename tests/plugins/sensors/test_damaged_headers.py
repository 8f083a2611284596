"""Whatever bytes a file begins with, sources raise nothing but InputError."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from photonpano import FrameSpan, InputError, SourceContext, discover

CATALOG = discover()
FRAMES = np.random.default_rng(0).integers(0, 2, (3, 10, 16), dtype=np.uint8)
TRANSFORMS = {"h": 10, "w": 16, "c": 1, "fps": 9.5, "bitpack": True, "bitpack_dim": 2, "file_path": "frames.npy"}
CHANGES = st.dictionaries(st.integers(0, 6000), st.integers(0, 255), min_size=1, max_size=6)
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["frames.npy", 1, 2, 10, 16]),
    lambda values: st.lists(values, max_size=3) | st.dictionaries(st.sampled_from([*TRANSFORMS, "frames", "offset"]), values),
    max_leaves=12,
)


def try_to_read(name: str, path: Path) -> None:
    contribution = CATALOG.find("source", name).contribution
    config = contribution.config(path=path)
    contribution.recognise(path)
    problems = list(contribution.check(config))
    try:
        with contribution.build(config, SourceContext()) as source:
            assert not problems, problems
            source.frames(FrameSpan(0, 1))
            source.counts(source.info.span)
    except InputError:
        pass


def changed(content: bytes, changes: dict[int, int]) -> bytes:
    damaged = bytearray(content)
    for place, value in changes.items():
        damaged[place % len(content)] = value
    return bytes(damaged)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hold a capture of each kind that has a header."""
    folder = tmp_path_factory.mktemp("fuzz")
    np.save(folder / "frames.npy", np.packbits(FRAMES, axis=2))
    for name, compressed in (("whole.mat", False), ("compressed.mat", True)):
        savemat(folder / name, {"TEXT": "text", "OUTPUT": np.moveaxis(FRAMES, 0, -1)}, do_compression=compressed)
    return folder


@settings(deadline=None, max_examples=40)
@given(content=st.binary(max_size=64) | st.lists(st.integers(0, 262145)).map(lambda words: np.array(words, "<u4").tobytes()))
@pytest.mark.parametrize("name", ["swissspad-half", "swissspad-full", "spad512", "spad512-sparse"])
def test_bin_source_raises_input_error_on_random_bytes(folder: Path, name: str, content: bytes) -> None:
    path = folder / "frames.bin"
    path.write_bytes(content)
    try_to_read(name, path)


@settings(deadline=None, max_examples=40)
@given(values=st.dictionaries(st.sampled_from([*TRANSFORMS, "frames"]), JSON, max_size=4))
def test_visionsim_raises_input_error_on_random_values(folder: Path, values: dict[str, Any]) -> None:
    (folder / "transforms.json").write_text(json.dumps(TRANSFORMS | {"frames": [{}] * 3} | values))
    try_to_read("visionsim", folder)


@settings(deadline=None, max_examples=40)
@given(changes=CHANGES)
def test_visionsim_raises_input_error_on_random_bytes(folder: Path, changes: dict[int, int]) -> None:
    content = json.dumps(TRANSFORMS | {"frames": [{}] * 3}).encode()
    (folder / "transforms.json").write_bytes(changed(content, changes))
    try_to_read("visionsim", folder)


@settings(deadline=None, max_examples=40)
@given(changes=CHANGES, info=st.none() | JSON, compressed=st.booleans())
def test_mat_parts_raises_input_error_on_random_bytes(
    folder: Path, changes: dict[int, int], info: Any, compressed: bool
) -> None:
    parts = folder / "parts"
    parts.mkdir(exist_ok=True)
    content = (folder / ("compressed.mat" if compressed else "whole.mat")).read_bytes()
    (parts / "part_1.mat").write_bytes(changed(content, changes))
    (parts / "info.json").unlink(missing_ok=True)
    if info is not None:
        (parts / "info.json").write_text(json.dumps(info))
    try_to_read("mat-parts", parts)


@pytest.fixture
def no_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files without a first look, which takes longer than all else here."""
    monkeypatch.setattr("photonpano_sensors.ubicept.look_first", lambda *_: None)


@pytest.fixture(scope="module")
def hdf5(folder: Path) -> bytes:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "capture.ubi.h5", "w") as file:
        for index, frame in enumerate(FRAMES):
            file[f"raw/{index}"] = frame
            file[f"raw/{index}"].attrs["metadata"] = '{"num_integrated_binary_frames": 3}'
    return bytes((folder / "capture.ubi.h5").read_bytes())


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kept=st.integers(0, 20_000), start=st.binary(max_size=12))
@pytest.mark.usefixtures("no_look")
def test_ubicept_raises_input_error_on_truncated_file(folder: Path, hdf5: bytes, kept: int, start: bytes) -> None:
    """Or begin with something else. Other bytes are not changed: the HDF5 library ends the process for some of these."""
    path = folder / "capture.ubi.h5"
    path.write_bytes((start + hdf5[len(start) :])[: kept % len(hdf5)])
    try_to_read("ubicept-h5", path)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(metadata=JSON | st.fixed_dictionaries({"num_integrated_binary_frames": JSON, "node_history": JSON}))
@pytest.mark.usefixtures("no_look")
def test_ubicept_raises_input_error_on_random_metadata(folder: Path, metadata: Any) -> None:
    h5py = pytest.importorskip("h5py")
    path = folder / "metadata.ubi.h5"
    with h5py.File(path, "w") as file:
        file["raw/0"] = FRAMES[0]
        file["raw/0"].attrs["metadata"] = json.dumps(metadata)
    try_to_read("ubicept-h5", path)
