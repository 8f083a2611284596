"""Errors of sources and trajectories name their plugin, whoever calls them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, KnowsSharpViews, KnowsTruth, LinearlyCorrectedSource, PackedSource, PluginError
from photonpano.capture import capture_of
from photonpano.contracts.attribution import AttributedTrajectory
from photonpano.protocols import ColouredSource

ORIGIN = "source 'toy' of toys 1.0"
SPAN = FrameSpan(2, 5)


@pytest.fixture
def source(memory_source: type) -> Any:
    return memory_source(np.random.default_rng(0).random((8, 4, 6)) < 0.5)


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any) -> Any:
        raise error

    return fail


def test_attributed_source_reads_what_the_source_reads(source: Any) -> None:
    named = capture_of(source, ORIGIN)
    assert (named.info, named.response) == (source.info, source.response)
    assert named.valid is source.valid
    np.testing.assert_array_equal(named.counts(SPAN), source.counts(SPAN))
    np.testing.assert_array_equal(named.frames(SPAN), source.frames(SPAN))


def test_attributed_source_has_the_optional_methods_of_the_source(source: Any) -> None:
    assert not isinstance(capture_of(source, ORIGIN), PackedSource | LinearlyCorrectedSource | KnowsTruth)
    source.packed = lambda span: np.packbits(source.frames(span), axis=-1)
    source.corrected = lambda counts, n_frames: counts - np.float32(n_frames)
    source.truth = lambda: {"scene": np.ones((4, 6))}
    named = capture_of(source, ORIGIN)
    assert isinstance(named, KnowsTruth)
    assert set(named.truth()) == {"scene"}
    assert isinstance(named, PackedSource)
    assert isinstance(named, LinearlyCorrectedSource)
    np.testing.assert_array_equal(named.packed(SPAN), source.packed(SPAN))
    np.testing.assert_array_equal(named.corrected(source.counts(SPAN), 3), source.counts(SPAN) - np.float32(3))
    source.packed = raising(OSError("gone"))
    with pytest.raises(PluginError, match=r"failed at frames 2 to 4: OSError: gone"):
        capture_of(source, ORIGIN).packed(SPAN)


def test_attributed_source_names_the_plugin_of_sharp_views(source: Any) -> None:
    source.truth = dict
    source.sharp_view = lambda frame: source.frames(FrameSpan(frame, frame + 1))[0].astype(np.float32)
    named = capture_of(source, ORIGIN)
    assert isinstance(named, KnowsSharpViews)
    np.testing.assert_array_equal(named.sharp_view(2), source.sharp_view(2))
    source.sharp_view = lambda _: np.zeros((2, 2), np.float32)
    with pytest.raises(PluginError, match=r"sharp_view\(\) returns \(4, 6\) of float32, got"):
        capture_of(source, ORIGIN).sharp_view(2)


def test_sources_of_colours_name_the_plugin_too(source: Any, memory_source: type) -> None:
    red = memory_source(source.frames(FrameSpan(0, 8)))
    red.counts = raising(OSError("gone"))
    source.colours = lambda: {"red": red}
    source.clear_mix = lambda: np.ones(3)
    named = capture_of(source, ORIGIN)
    assert isinstance(named, ColouredSource)
    with pytest.raises(PluginError, match=r"toys 1\.0.* failed at frames 2 to 4: OSError: gone"):
        named.colours()["red"].counts(SPAN)


def test_attributed_source_closes_the_source(source: Any) -> None:
    closed: list[bool] = []
    source.close = lambda: closed.append(True)
    with capture_of(source, ORIGIN):
        assert not closed
    assert closed


@pytest.mark.parametrize("method", ["counts", "frames"])
def test_attributed_source_names_plugin_on_exception_or_wrong_shape(source: Any, method: str) -> None:
    named = capture_of(source, ORIGIN)
    setattr(source, method, raising(OSError("gone")))
    with pytest.raises(PluginError) as caught:
        getattr(named, method)(SPAN)
    assert str(caught.value) == f"{ORIGIN} failed at frames 2 to 4: OSError: gone"
    setattr(source, method, lambda _: np.zeros((6, 4)))
    with pytest.raises(PluginError) as caught:
        getattr(named, method)(SPAN)
    expected = {"counts": "(4, 6)", "frames": "(3, 4, 6)"}[method]
    assert str(caught.value) == f"{ORIGIN} broke its contract at frames 2 to 4: expected the shape {expected}, got (6, 4)"


def test_attributed_source_passes_errors_written_for_users(source: Any) -> None:
    error = InputError("the disk was pulled out")
    source.counts = raising(error)
    with pytest.raises(InputError) as caught:
        capture_of(source, ORIGIN).counts(SPAN)
    assert caught.value is error


def test_attributed_trajectory_returns_what_the_trajectory_returns(pan: Callable) -> None:
    motion = pan(0.3)
    named = AttributedTrajectory(motion, "interpolator 'toy' of toys 1.0", 2)
    for frames in ([3], [0, 2.5, 7], np.arange(4), 3):
        np.testing.assert_array_equal(named.at(frames), motion.at(frames))


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (raising(KeyError("knot")), "failed at level 2: KeyError: 'knot'"),
        (lambda _: np.eye(3), "broke its contract at level 2: expected homographies of the shape (2, 3, 3), got (3, 3)"),
        (
            lambda _: [np.eye(3), np.diag([1.0, 1.0, 0.0])],
            "broke its contract at level 2: a homography is finite with h33 = 1, that of frame 7.5 is "
            "[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]",
        ),
    ],
    ids=["raises", "shape", "h33"],
)
def test_attributed_trajectory_names_interpolator_on_exception_or_broken_contract(
    answer: Callable[..., Any], problem: str
) -> None:
    class Odd:
        at = staticmethod(answer)

    with pytest.raises(PluginError) as caught:
        AttributedTrajectory(Odd(), "interpolator 'toy' of toys 1.0", 2).at([3, 7.5])
    assert str(caught.value) == f"interpolator 'toy' of toys 1.0 {problem}"


@pytest.mark.parametrize("method", ["counts", "frames", "packed"])
def test_array_that_changes_after_it_was_returned_is_refused(source: Any, method: str) -> None:
    source.packed = lambda span: np.packbits(source.frames(span), axis=-1)
    buffer, read = np.zeros(10_000, np.uint8), getattr(source, method)

    def reusing(span: FrameSpan) -> np.ndarray:
        found = read(span).astype(np.uint8)
        buffer[: found.size] = found.ravel()
        return buffer[: found.size].reshape(found.shape)

    setattr(source, method, reusing)
    with pytest.raises(PluginError) as caught:
        getattr(capture_of(source, ORIGIN), method)(SPAN)
    assert str(caught.value) == (
        f"{ORIGIN} broke its contract at frames 2 to 4: "
        f"the array that {method}() returned changed when other frames were read; return a new array"
    )


def test_corrected_sums_and_truth_are_checked(source: Any) -> None:
    source.corrected = lambda counts, _: counts
    source.truth = lambda: [1]
    named = capture_of(source, ORIGIN)
    with pytest.raises(PluginError) as caught:
        named.corrected(source.counts(SPAN), 3)
    assert str(caught.value) == (
        f"{ORIGIN} broke its contract at correcting: corrected() returns (4, 6) of float32, got (4, 6) of uint32"
    )
    with pytest.raises(PluginError) as caught:
        named.truth()
    assert (
        str(caught.value) == f"{ORIGIN} broke its contract at truth(): truth() returns a mapping of arrays by name, got a list"
    )


def test_values_of_later_reads_are_checked_now_and_then(source: Any) -> None:
    named, good = capture_of(source, ORIGIN), source.counts(SPAN)
    for _ in range(20):
        named.counts(SPAN)
    source.counts = lambda _: good + np.uint32(9)
    with pytest.raises(PluginError, match=r"counts\(\) returns numbers from 0 to 3 for these frames, got 1"):
        [named.counts(SPAN) for _ in range(32)]
