"""What is tried where the exposures of a capture are not tied together."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, LocationError, parse_spec
from photonpano.execution.context import Context
from photonpano.motion.diagnosis import UntiedError
from photonpano.pipeline.components import build_source
from photonpano.pipeline.estimate import estimate
from photonpano.pipeline.obstacles import ApartError

SPEC = {
    "version": 1,
    "source": {"use": "simulator", "with": {"n_frames": 100, "frame_shape": [32, 48]}},
    "motion": {"start": "constant-velocity"},
}


def spans(*bounds: int) -> tuple[FrameSpan, ...]:
    return tuple(FrameSpan(start, stop) for start, stop in pairwise(bounds))


def timelines_of(found: list[tuple[FrameSpan, ...]], monkeypatch: pytest.MonkeyPatch) -> list[tuple[FrameSpan, ...]]:
    """Return the shots of each attempt of a run that finds these shots, one after the other."""
    attempts, left = [], list(found)

    def along(timeline: Any, *_: Any) -> str:
        attempts.append(timeline.shots)
        if left:
            raise ApartError(left.pop(0))
        return "a state"

    monkeypatch.setattr("photonpano.pipeline.estimate._along", along)
    plan = parse_spec(SPEC)
    assert estimate(plan, build_source(plan), [], Context(1)) == "a state"
    return attempts


def test_a_shot_that_falls_apart_is_divided_too(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [spans(0, 30, 100), spans(0, 80, 100)]
    assert timelines_of(found, monkeypatch) == [(), spans(0, 30, 100), spans(0, 30, 80, 100)]


def test_shots_that_are_found_twice_end_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LocationError, match=r"^frames 0 to 29 and frames 30 to 99 are not tied together"):
        timelines_of([spans(0, 30, 100)] * 2, monkeypatch)


@pytest.mark.parametrize(("signal_to_noise", "shortened"), [(0.5, [1, 1, 2, 4]), (0.1, [1, 1])], ids=["blurred", "dark"])
def test_what_was_tried_in_vain_is_told(signal_to_noise: float, shortened: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant velocity, and shorter groups where darkness is not the cause."""
    attempts: list[int] = []

    def along(*given: Any) -> None:
        attempts.append(given[-1])
        raise UntiedError(f"attempt {len(attempts)} fails", 1, (), (), np.zeros(0, int), signal_to_noise, None)

    monkeypatch.setattr("photonpano.pipeline.estimate._along", along)
    monkeypatch.setattr("photonpano.pipeline.estimate.shots_of", lambda *_: ())
    plan = parse_spec(SPEC | {"motion": {"start": "none"}})
    with pytest.raises(UntiedError) as caught:
        estimate(plan, build_source(plan), [], Context(1))
    assert attempts == shortened
    names = ["motion: {start: constant-velocity}", "1/2 of the group size", "1/4 of the group size"]
    tried = [
        f"{name} was tried, too: attempt {number} fails" for number, name in enumerate(names[: len(shortened) - 1], start=2)
    ]
    assert str(caught.value).splitlines() == ["attempt 1 fails", *tried]
