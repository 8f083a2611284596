import dataclasses

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, StreamInfo
from photonpano.values import true_spans


@pytest.mark.parametrize(("start", "stop"), [(-1, 3), (3, 3), (4, 3)])
def test_frame_span_refuses_empty_range(start: int, stop: int) -> None:
    with pytest.raises(ValueError, match=rf"0 <= start < stop, got \[{start}, {stop}\)"):
        FrameSpan(start, stop)


def test_true_spans_returns_runs_of_set_flags() -> None:
    flags = np.array([True, False, False, True, True, True, False, True])
    assert true_spans(flags) == [FrameSpan(0, 1), FrameSpan(3, 6), FrameSpan(7, 8)]
    assert true_spans(np.zeros(5, bool)) == []


def test_group_refuses_reference_outside_span() -> None:
    span = FrameSpan(10, 14)
    assert {Group(span, reference).reference for reference in (10, 11.5, 13)} == {10, 11.5, 13}
    for outside in (9.5, 13.5, float("nan")):
        with pytest.raises(ValueError, match="lies outside frames 10 to 13"):
            Group(span, outside)


def test_stream_info_require_refuses_frames_beyond_the_end() -> None:
    stream = StreamInfo(100, 4, 6, None)
    assert (stream.frame_shape, stream.span) == ((4, 6), FrameSpan(0, 100))
    stream.require(FrameSpan(90, 100))
    with pytest.raises(InputError) as caught:
        stream.require(FrameSpan(90, 101))
    assert str(caught.value) == "frames 90 to 100 were requested, but the capture has 100 frames (0 to 99)"


@pytest.mark.parametrize("value", [FrameSpan(0, 1), Group(FrameSpan(0, 1), 0), StreamInfo(1, 1, 1, None)])
def test_values_are_frozen(value: FrameSpan | Group | StreamInfo) -> None:
    field = dataclasses.fields(value)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, field, None)
