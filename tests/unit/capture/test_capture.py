"""The record of a capture: which of the optional members apply, and what the functions that make the next record change."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from photonpano import (
    Capture,
    ColouredSource,
    FrameSpan,
    InputError,
    KnowsSharpViews,
    KnowsTruth,
    LensedSource,
    Light,
    LinearlyCorrectedSource,
    LitSource,
    PackedSource,
    WeightedSource,
    capture_of,
)
from photonpano.capture import in_light, part_of, seen_through
from photonpano.corrections import CORRECTIONS, ColourFilter, Vignette, corrected_source, divided_by
from photonpano.geometry import Camera
from photonpano.testing import MemorySource

SHAPE, N = (8, 16), 40
FRAMES = np.random.default_rng(0).integers(0, 2, (N, *SHAPE), dtype=np.uint8)
OPTIONAL = (
    PackedSource,
    LinearlyCorrectedSource,
    WeightedSource,
    ColouredSource,
    LitSource,
    LensedSource,
    KnowsTruth,
    KnowsSharpViews,
)
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


@pytest.mark.parametrize(
    ("change", "gains", "loses"),
    [
        (capture_of, (), ()),
        (partial(in_light, light=LIGHT), (LitSource,), ()),
        (partial(seen_through, camera=Camera.of(40.0, SHAPE)), (LensedSource,), ()),
        (partial(part_of, span=FrameSpan(2, 9)), (), ()),
        (partial(divided_by, vignette=GAIN), (LinearlyCorrectedSource, WeightedSource), ()),
        (partial(corrected_source, corrections=[CORRECTIONS["rot180"]()]), (), (KnowsTruth, KnowsSharpViews)),
        (
            partial(corrected_source, corrections=[ColourFilter(pattern="rggb", keep="all")]),
            (LinearlyCorrectedSource, WeightedSource, ColouredSource),
            (KnowsSharpViews,),
        ),
    ],
)
def test_isinstance_says_what_applies(
    change: Callable[[Any], Capture], gains: tuple[type, ...], loses: tuple[type, ...]
) -> None:
    simulated = {PackedSource, KnowsTruth, KnowsSharpViews}
    for source, own in ((MemorySource(FRAMES), set[type]()), (Simulated(FRAMES), simulated)):
        assert {each for each in OPTIONAL if isinstance(source, each)} == own
        changed = change(source)
        assert {each for each in OPTIONAL if isinstance(changed, each)} == (own | set(gains)) - set(loses)


def test_capture_without_anything_to_correct_returns_the_counts_themselves() -> None:
    capture = capture_of(MemorySource(FRAMES))
    counts = capture.counts(FrameSpan(0, 9))
    assert capture.corrected(counts, 9) is counts
    assert capture.truth() is None
    assert capture.colours() == {}
    np.testing.assert_array_equal(capture.weights(), np.ones(SHAPE))
    np.testing.assert_array_equal(capture.packed(FrameSpan(0, 9)), np.packbits(FRAMES[:9], axis=-1))


def test_chunks_are_sums_of_the_spans() -> None:
    spans = [FrameSpan(0, 5), FrameSpan(5, 12)]
    sums = list(capture_of(MemorySource(FRAMES)).chunks(spans))
    np.testing.assert_array_equal(sums, [FRAMES[span.start : span.stop].sum(axis=0) for span in spans])


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


def test_pixels_moved_twice_are_gathered_once() -> None:
    turned, twice = (CORRECTIONS["rot90"](), CORRECTIONS["missing-row"]()), CORRECTIONS["flip-lr"]()
    once = corrected_source(MemorySource(FRAMES), (*turned, twice))
    again = corrected_source(corrected_source(MemorySource(FRAMES), turned), (twice,))
    np.testing.assert_array_equal(again.frames(FrameSpan(3, 9)), once.frames(FrameSpan(3, 9)))
    np.testing.assert_array_equal(again.valid, once.valid)


def test_colours_are_seen_in_the_light_through_the_lens_and_divided_by_the_gain_of_the_grey_capture() -> None:
    grey = corrected_source(MemorySource(FRAMES), [ColourFilter(pattern="rggb", keep="all")])
    seen = part_of(seen_through(in_light(divided_by(grey, GAIN), LIGHT), Camera.of(40.0, SHAPE)), FrameSpan(2, 9))
    for name, each in seen.colours().items():
        assert (each.info, each.first, each.light, each.camera) == (seen.info, 2, seen.light, seen.camera)
        np.testing.assert_array_equal(each.valid, grey.colours()[name].valid)
        np.testing.assert_array_equal(each.weights(), GAIN.gain)
        assert each.corrected_counts(FrameSpan(0, 3)).dtype == np.float32
