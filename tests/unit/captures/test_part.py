"""A part of a capture, and the key `frames` of every source, which names one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import (
    Config,
    FrameSpan,
    SourceContribution,
    SpecError,
    open_source,
    parse_spec,
    run,
    simulate,
)
from photonpano.captures.writing import truth_path
from photonpano.pipeline.components import build_source


def part(path: Path, start: int, stop: int) -> dict[str, Any]:
    return {"use": "packed-npy", "with": {"path": str(path), "frames": [start, stop]}}


def test_part_holds_the_frames_of_its_span(small_capture: Path) -> None:
    source = {"use": "packed-npy", "with": {"path": str(small_capture)}}
    whole = build_source(parse_spec({"version": 1, "source": source}))
    some = build_source(parse_spec({"version": 1, "source": part(small_capture, 40, 100)}))
    with whole, some:
        assert (some.info.n_frames, some.info.frame_shape) == (60, whole.info.frame_shape)
        inner, outer = FrameSpan(5, 20), FrameSpan(45, 60)
        for method in ("counts", "frames", "packed"):
            np.testing.assert_array_equal(getattr(some, method)(inner), getattr(whole, method)(outer))


def test_run_of_a_part_is_that_of_a_capture_with_these_frames(
    small_capture: Path, tmp_path: Path, without_report: None
) -> None:
    np.save(tmp_path / "cut.npy", np.load(small_capture)[40:240])
    cut = {"use": "packed-npy", "with": {"path": str(tmp_path / "cut.npy")}}
    rest = {"version": 1, "resample": {"with": {"group_size": 50}}, "levels": 1}
    of_part, of_file = (
        run(parse_spec(rest | {"source": source}, output=tmp_path / name)).record
        for name, source in (("part", part(small_capture, 40, 240)), ("file", cut))
    )
    assert of_part["files"] == of_file["files"]
    assert of_part["source"]["n_frames"] == 200


def test_truth_of_a_part_is_that_of_its_frames(tmp_path: Path) -> None:
    keys = {"n_frames": 60, "frame_shape": [24, 32], "path": {"kind": "pan", "length_px": 20}}
    truths = []
    for name, more in (("whole", {}), ("part", {"frames": [10, 40]})):
        spec = parse_spec({"version": 1, "source": {"use": "simulator", "with": keys | more}})
        with np.load(truth_path(simulate(spec, tmp_path / f"{name}.npy").path)) as truth:
            truths.append(dict(truth))
    whole, some = truths
    np.testing.assert_array_equal(some["homographies"], whole["homographies"][10:40])
    np.testing.assert_array_equal(some["scene"], whole["scene"])


def test_part_of_a_capture_with_depth_shows_the_same_views() -> None:
    from photonpano import KnowsSharpViews, open_source
    from photonpano_simulator.travel.truth import sharp_view, truth_of

    thing = {"moves_px": [0.5, 0]}
    keys = {
        "scene": {"kind": "planes"},
        "n_frames": 60,
        "frame_shape": [24, 32],
        "focal_px": 25,
        "drift": 2,
        "objects": [thing],
    }
    views = []
    for more, frame in (({}, 30), ({"frames": [10, 40]}, 20)):
        with open_source(parse_spec({"version": 1, "source": {"use": "travel-simulator", "with": keys | more}})) as source:
            assert isinstance(source, KnowsSharpViews)
            views += [source.sharp_view(frame), sharp_view(truth_of(source.truth()), frame)]
    for view in views[1:]:
        np.testing.assert_array_equal(view, views[0])


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([0, 301], "the capture has 300 frames: expected [start, stop] with stop up to 300, got [0, 301]"),
        ([9, 9], "expected [start, stop] with start < stop, got [9, 9]"),
        ([-1, 9], "expected an integer of at least 0, got -1"),
        (9, "expected a list of 2 items or null, got 9"),
    ],
)
def test_frames_that_are_no_part_of_the_capture_are_named(small_capture: Path, frames: Any, message: str) -> None:
    source = {"use": "packed-npy", "with": {"path": str(small_capture), "frames": frames}}
    with pytest.raises(SpecError) as caught, open_source(parse_spec({"version": 1, "source": source})):
        pass
    assert str(caught.value).endswith(message)


def test_source_with_a_key_frames_of_its_own_is_refused() -> None:
    class Keys(Config):
        frames: int = 3

    with pytest.raises(ValueError, match="toy: the key 'frames' of a source is the framework's; give yours another name"):
        SourceContribution(name="toy", summary="Toy", config=Keys, build=lambda *_: None)
