"""Values that travel to other processes."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import photonpano.pipeline.run as run_module
from photonpano import FrameSpan, Light, parse_spec, run
from photonpano.capture import Capture, capture_of, in_light, part_of, seen_through
from photonpano.contracts.protocols import Source
from photonpano.corrections import ColourFilter, HotPixels, Vignette, corrected_source, divided_by
from photonpano.execution.executor import packed, unpacked
from photonpano.geometry import Camera
from photonpano.pipeline.executors import CaptureOpener, met_elsewhere
from photonpano.testing import MemorySource

SHAPE, N = (24, 32), 60
SPAN = FrameSpan(3, 30)
VIGNETTE = Vignette(np.linspace(0.5, 1, 24 * 32, dtype=np.float32).reshape(SHAPE), np.full(SHAPE, 0.3, np.float32), ())
WRAPPERS: dict[str, Callable[[Source], Capture]] = {
    "part": partial(part_of, span=FrameSpan(2, 50)),
    "hot pixels": partial(corrected_source, corrections=[HotPixels()]),
    "colours": partial(corrected_source, corrections=[ColourFilter(pattern="rggb", keep="all")]),
    "vignette": partial(divided_by, vignette=VIGNETTE),
    "light": partial(in_light, light=Light.of_frames(np.linspace(0.5, 1.5, N))),
    "camera": partial(seen_through, camera=Camera.of(40.0, SHAPE)),
}


def capture() -> Capture:
    return capture_of(MemorySource(np.random.default_rng(0).random((N, *SHAPE)) < 0.3), "a source of this test")


@pytest.mark.parametrize("name", WRAPPERS)
def test_sources_arrive_as_they_left(name: str) -> None:
    here, there = capture(), capture()
    sent = WRAPPERS[name](here)
    data = packed(sent, capture_of(here).source)
    arrived: Capture = unpacked(data, capture_of(there).source)
    np.testing.assert_array_equal(arrived.counts(SPAN), sent.counts(SPAN))
    np.testing.assert_array_equal(arrived.valid, sent.valid)
    assert arrived.info == sent.info
    counts = sent.counts(SPAN)
    np.testing.assert_array_equal(arrived.corrected(counts, 27), sent.corrected(counts, 27))
    for colour, source in sent.colours().items():
        np.testing.assert_array_equal(arrived.colours()[colour].valid, source.valid)
    assert (sent.light is None) == (arrived.light is None)
    assert (sent.camera is None) == (arrived.camera is None)


def test_frames_do_not_travel() -> None:
    here = capture_of(MemorySource(np.zeros((5000, *SHAPE), bool)), "a source of this test")
    assert len(packed(part_of(here, FrameSpan(0, 4000)), here.source)) < 2000


class Elsewhere:
    """An executor that lets every task see copies alone, as another process would."""

    under_way = 2

    def __init__(self) -> None:
        self.capture: Source | None = None

    def at_once(self, number: int) -> int:
        return min(3, number)

    def copied(self, value: Any) -> Any:
        return unpacked(packed(value, self.capture), self.capture)

    def share(self, value: Any) -> Any:
        return self.copied(value)

    def call(self, work: Callable[..., Any], *given: Any) -> Any:
        return self.copied(work(*given))

    def keep(self, work: Callable[..., Any], *given: Any) -> Any:
        return self.copied(work(*given))


def test_run_on_copies_has_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = {
        "use": "simulator",
        "with": {
            "scene": {"kind": "street", "width": 400, "height": 300},
            "path": {"kind": "pan", "length_px": 30},
            "flux": 1,
            "n_frames": 250,
            "frame_shape": [64, 96],
        },
    }
    spec = {"version": 1, "source": source, "resample": {"with": {"group_size": 50}}, "levels": 2}
    run(parse_spec(spec, output=tmp_path / "here"))
    elsewhere = Elsewhere()

    @contextmanager
    def executor_elsewhere(_: Any, source: Source) -> Iterator[Elsewhere]:
        elsewhere.capture = capture_of(source).source
        yield elsewhere

    monkeypatch.setattr(run_module, "executor_of", executor_elsewhere)
    run(parse_spec(spec, output=tmp_path / "there"))
    assert elsewhere.capture is not None
    for name in ("trajectory.npz", "panorama.tiff"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def opener_of(path: Path, needed: Mapping[str, str]) -> CaptureOpener:
    return CaptureOpener("run", 0, "packed-npy", {"path": path}, needed)


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for name in ("one.npy", "other.npy"):
        np.save(tmp_path / name, rng.integers(0, 256, (9, 16, 4), dtype=np.uint8))
    return tmp_path


def test_processes_are_told_apart_by_versions_and_capture(captures: Path) -> None:
    needed = dict.fromkeys(("python", "photonpano", "no-such-thing"), "")
    here, there, nowhere = (met_elsewhere(opener_of(captures / f"{name}.npy", needed)) for name in ("one", "other", "none"))
    assert here["no-such-thing"] == "missing"
    assert here["python"] == there["python"]
    assert here["capture"] != there["capture"]
    assert here == met_elsewhere(opener_of(captures / "one.npy", needed))
    assert "there is no file" in nowhere["capture"]
