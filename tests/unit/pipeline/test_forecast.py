from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, LinearlyCorrectedSource, PackedSource
from photonpano.pipeline.components import build_source
from photonpano.pipeline.forecast import TRIAL_GROUPS, forecast, part_of
from photonpano.specs import parse_spec
from photonpano.testing import MemorySource


def test_part_of_capture_numbers_its_frames_from_zero(memory_source: type[MemorySource]) -> None:
    frames = np.random.default_rng(0).integers(0, 2, (9, 4, 8), dtype=np.uint8)
    part = part_of(memory_source(frames), FrameSpan(2, 7))
    assert part.info.n_frames == 5
    np.testing.assert_array_equal(part.counts(FrameSpan(1, 4)), frames[3:6].sum(axis=0))
    np.testing.assert_array_equal(part.frames(FrameSpan(0, 5)), frames[2:7])
    with pytest.raises(InputError, match="the capture has 5 frames"):
        part.counts(FrameSpan(3, 6))


def test_part_of_capture_has_the_optional_methods_of_the_capture(memory_source: type[MemorySource]) -> None:
    whole: Any = memory_source(np.random.default_rng(0).integers(0, 2, (9, 4, 8), dtype=np.uint8))
    assert not isinstance(part_of(whole, FrameSpan(2, 7)), PackedSource | LinearlyCorrectedSource)
    whole.packed = lambda span: np.packbits(whole.frames(span), axis=-1)
    whole.corrected = lambda counts, n_frames: counts - np.float32(n_frames)
    part = part_of(whole, FrameSpan(2, 7))
    assert isinstance(part, PackedSource)
    assert isinstance(part, LinearlyCorrectedSource)
    np.testing.assert_array_equal(part.packed(FrameSpan(1, 4)), whole.packed(FrameSpan(3, 6)))
    assert part.corrected(np.uint32([[5]]), 3) == 2


def test_forecast_predicts_time_memory_and_canvas(small_spec: dict[str, Any]) -> None:
    plan = parse_spec(small_spec | {"resample": {"with": {"group_size": 20}}, "levels": 2})
    with build_source(plan) as source:
        found = forecast(plan, source)
        n_frames = source.info.n_frames
    assert len(found.tried) == 20 * TRIAL_GROUPS < n_frames
    assert abs(found.tried.centre - (n_frames - 1) / 2) <= 1
    assert set(found.seconds) == {"level 1", "level 2", "panorama"}
    assert min(found.seconds.values()) > 0
    assert found.memory_bytes > 30 * 2**20
    # The camera pans by 60 px over the capture, and trembles.
    assert 190 < found.canvas[1] < 290
    assert 128 <= found.canvas[0] < 220


@pytest.mark.parametrize(("extent", "shape"), [("reference", (256, 320)), ([-10, 5, 20, 25], (40, 60))])
def test_forecast_of_a_part_has_the_size_of_the_part(small_spec: dict[str, Any], extent: Any, shape: tuple[int, int]) -> None:
    render = {"extent": extent, "scale": 2}
    plan = parse_spec(small_spec | {"resample": {"with": {"group_size": 10}}, "levels": 1, "render": render})
    with build_source(plan) as source:
        assert forecast(plan, source).canvas == shape
