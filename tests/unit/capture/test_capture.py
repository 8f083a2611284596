"""The record of a capture: optional members, the plugin that errors name, and what functions change."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import (
    FrameSpan,
    InputError,
    Light,
    PluginError,
    capture_of,
)
from photonpano.capture import in_light, part_of, seen_through
from photonpano.corrections import CORRECTIONS, ColourFilter, Vignette, corrected_source, divided_by
from photonpano.geometry import Camera
from photonpano.testing import MemorySource

SHAPE, N = (8, 16), 40
FRAMES = np.random.default_rng(0).integers(0, 2, (N, *SHAPE), dtype=np.uint8)
LIGHT = Light.of_frames(np.linspace(0.5, 1.5, N))
GAIN = Vignette(np.full(SHAPE, 0.5, np.float32), np.full(SHAPE, 0.3, np.float32), (), np.full(SHAPE, 0.1, np.float32))


class Simulated(MemorySource):
    """Frames with a truth, packed as well."""

    def packed(self, span: FrameSpan) -> np.ndarray:
        return np.packbits(self.frames(span), axis=-1)

    def truth(self) -> dict[str, np.ndarray]:
        return {"homographies": np.arange(N), "scene": np.ones(3)}

    def sharp_view(self, frame: int) -> np.ndarray:
        self.info.require(FrameSpan(frame, frame + 1))
        return np.full(SHAPE, frame, np.float32)


def tenfold(counts: np.ndarray, _: int) -> np.ndarray:
    return (counts * np.uint8(10)).astype(np.float32)


@pytest.mark.parametrize(("n_frames", "kind"), [(3, np.uint8), (255, np.uint8), (256, np.uint32)])
def test_chunk_is_the_sum_in_the_smallest_type_that_holds_it(n_frames: int, kind: type) -> None:
    lit = np.ones((300, *SHAPE), np.uint8)
    lit[:, 2, 3] = 0
    capture, span = replace(capture_of(Simulated(lit)), steps=(tenfold,)), FrameSpan(7, 7 + n_frames)
    chunk = capture.chunk(span)
    assert chunk.dtype == kind
    np.testing.assert_array_equal(chunk, capture.counts(span))
    np.testing.assert_array_equal(capture.corrected(chunk, n_frames), 10.0 * capture.counts(span))
    turned = corrected_source(Simulated(lit), [CORRECTIONS["rot90"]()])
    np.testing.assert_array_equal(turned.chunk(span), turned.counts(span))


def test_part_numbers_its_frames_from_zero_in_every_member() -> None:
    part = part_of(part_of(in_light(Simulated(FRAMES), LIGHT), FrameSpan(2, 30)), FrameSpan(1, 7))
    assert part.info.n_frames == 6
    np.testing.assert_array_equal(part.counts(FrameSpan(1, 4)), FRAMES[4:7].sum(axis=0))
    np.testing.assert_array_equal(part.packed(FrameSpan(0, 6)), np.packbits(FRAMES[3:9], axis=-1))
    assert part.light is not None
    np.testing.assert_array_equal(part.light.gain, LIGHT.gain[3:9])
    truth = part.truth()
    assert truth is not None
    assert [each.tolist() for each in truth.values()] == [[*range(3, 9)], [1, 1, 1]]
    assert part.sharp_view(2)[0, 0] == 5
    for read in (part.counts, part.frames, part.packed):
        with pytest.raises(InputError, match="the capture has 6 frames"):
            read(FrameSpan(3, 7))
    with pytest.raises(InputError, match="the capture has 6 frames"):
        part.sharp_view(6)


def test_colours_are_seen_in_the_light_through_the_lens_and_divided_by_the_gain_of_the_grey_capture() -> None:
    grey = corrected_source(MemorySource(FRAMES), [ColourFilter(pattern="rggb", keep="all")])
    seen = part_of(seen_through(in_light(divided_by(grey, GAIN), LIGHT), Camera.of(40.0, SHAPE)), FrameSpan(2, 9))
    for name, each in seen.colours().items():
        assert (each.info, each.first, each.light, each.camera) == (seen.info, 2, seen.light, seen.camera)
        np.testing.assert_array_equal(each.valid, grey.colours()[name].valid)
        np.testing.assert_array_equal(each.weights(), GAIN.gain)
        assert each.corrected_counts(FrameSpan(0, 3)).dtype == np.float32


ORIGIN = "source 'toy' of toys 1.0"
SPAN = FrameSpan(2, 5)


@pytest.fixture
def source(memory_source: type) -> Any:
    """Frames in memory, with some of the optional methods."""
    source: Any = memory_source(np.random.default_rng(0).random((8, 4, 6)) < 0.5)
    source.packed = lambda span: np.packbits(source.frames(span), axis=-1)
    source.truth = lambda: {"scene": np.ones((4, 6))}
    source.sharp_view = lambda frame: source.frames(FrameSpan(frame, frame + 1))[0].astype(np.float32)
    return source


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any) -> Any:
        raise error

    return fail


@pytest.mark.parametrize(
    ("method", "given", "where", "answer", "problem"),
    [
        ("counts", (SPAN,), "frames 2 to 4", np.zeros((6, 4)), "expected the shape (4, 6), got (6, 4)"),
        ("frames", (SPAN,), "frames 2 to 4", np.zeros((6, 4)), "expected the shape (3, 4, 6), got (6, 4)"),
        ("packed", (SPAN,), "frames 2 to 4", np.zeros((6, 4)), "expected the shape (3, 4, 1), got (6, 4)"),
        ("truth", (), "truth()", [1], "expected Mapping, got a list"),
        (
            "sharp_view",
            (2,),
            "sharp_view()",
            np.zeros((2, 2), np.float32),
            "the result of sharp_view() must be (4, 6) of float32, got (2, 2) of float32",
        ),
    ],
)
def test_plugin_is_named_on_exception_and_on_a_wrong_answer(
    source: Any, method: str, given: tuple[Any, ...], where: str, answer: Any, problem: str
) -> None:
    named = capture_of(source, ORIGIN)
    for reply, said in (
        (raising(OSError("gone")), f"{ORIGIN} failed at {where}: OSError: gone"),
        (lambda *_: answer, f"{ORIGIN} broke its contract at {where}: {problem}"),
    ):
        setattr(source, method, reply)
        with pytest.raises(PluginError) as caught:
            getattr(named, method)(*given)
        assert str(caught.value) == said


def test_source_of_0_2_that_corrects_its_sums_is_read_with_a_warning(source: Any, caplog: pytest.LogCaptureFixture) -> None:
    source.corrected, source.light = lambda counts, _: counts / 2, LIGHT
    named = capture_of(source, ORIGIN)
    np.testing.assert_array_equal(named.corrected_counts(SPAN), source.counts(SPAN))
    assert caplog.messages == [
        f"{ORIGIN}: no longer used of a source: corrected and light; correct its frames, or write `corrections` or `light` "
        "in the spec"
    ]


def test_name_of_0_2_that_was_removed_says_what_to_read_instead() -> None:
    with pytest.raises(ImportError, match=r"LitSource was removed after 0.2: a component reads `corrects_sums`, `weight`"):
        from photonpano import LitSource  # noqa: F401
