"""Values that travel to other processes."""

import pickle
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import Config, ExecutorContribution, FrameSpan, InputError, Light, Plan, PluginError, discover, parse_spec, run
from photonpano.capture import Capture, PluginSource, capture_of, in_light, part_of, seen_through
from photonpano.contracts.protocols import Source
from photonpano.corrections import ColourFilter, HotPixels, Vignette, corrected_source, divided_by
from photonpano.geometry import Camera
from photonpano.pipeline.executors import CaptureOpener, met_by
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


def opened() -> PluginSource:
    return PluginSource(MemorySource(np.random.default_rng(0).random((N, *SHAPE)) < 0.3), "a source of this test")


def copied(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))


@pytest.mark.parametrize("name", WRAPPERS)
def test_sources_arrive_as_they_left(name: str) -> None:
    here = capture_of(opened().given, "a source of this test")
    here.source.opener = opened
    sent = WRAPPERS[name](here)
    arrived: Capture = copied(sent)
    assert arrived.source is not here.source
    np.testing.assert_array_equal(arrived.counts(SPAN), sent.counts(SPAN))
    np.testing.assert_array_equal(arrived.valid, sent.valid)
    assert arrived.info == sent.info
    counts = sent.counts(SPAN)
    np.testing.assert_array_equal(arrived.corrected(counts, 27), sent.corrected(counts, 27))
    for colour, part in sent.colours().items():
        np.testing.assert_array_equal(arrived.colours()[colour].valid, part.valid)
    assert (sent.light is None) == (arrived.light is None)
    assert (sent.camera is None) == (arrived.camera is None)


class Elsewhere(Executor):
    """An executor that lets every task see copies alone, as another process would."""

    def submit(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        done = Future[Any]()
        work, given = copied((work, given))
        done.set_result(copied(work(*given)))
        return done


class Older:
    """An executor as they were until 0.2."""

    def share(self, value: Any) -> Any:
        return value


class NoKeys(Config):
    pass


def plan_on(executor: type[Any], output: Path) -> Plan:
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
    offer = ExecutorContribution(name="other", summary="Another", config=NoKeys, build=lambda *_: executor())
    return parse_spec(spec | {"run": {"executor": "other"}}, output=output, catalog=discover().including(offer))


def test_run_on_copies_has_the_same_bytes(tmp_path: Path) -> None:
    for name, executor in (("here", ThreadPoolExecutor), ("there", Elsewhere)):
        run(plan_on(executor, tmp_path / name))
    for name in ("trajectory.npz", "panorama.tiff"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_executor_of_the_older_contract_is_told_what_to_change(tmp_path: Path) -> None:
    with pytest.raises(PluginError, match=r"no submit, map nor shutdown; return a concurrent.futures.Executor in place of one"):
        run(plan_on(Older, tmp_path))


def test_process_that_lacks_what_the_run_needs_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("one.npy", "other.npy"):
        np.save(tmp_path / name, rng.integers(0, 256, (9, 16, 4), dtype=np.uint8))

    def opener_of(name: str, needed: Mapping[str, str]) -> CaptureOpener:
        return CaptureOpener("run", 0, "packed-npy", {"path": tmp_path / name}, needed)

    needed = met_by(("python", "photonpano"), opener_of("one.npy", {})())
    opener_of("one.npy", needed)()
    with pytest.raises(InputError, match=r"a worker on \S+ differs from the process of the run: python \S+ \(here 3.1\); it"):
        opener_of("one.npy", needed | {"python": "3.1"})()
    for name, found in (("other.npy", r"capture \w+ \(here"), ("none.npy", "there is no file")):
        with pytest.raises(InputError, match=found):
            opener_of(name, needed)()
