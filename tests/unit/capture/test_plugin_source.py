"""The capture that any source gives: what the source reads, errors that name its plugin, and arrays that are checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, PluginError, capture_of

ORIGIN = "source 'toy' of toys 1.0"
SPAN = FrameSpan(2, 5)


@pytest.fixture
def source(memory_source: type) -> Any:
    """Frames in memory, with some of the optional methods."""
    source: Any = memory_source(np.random.default_rng(0).random((8, 4, 6)) < 0.5)
    source.packed = lambda span: np.packbits(source.frames(span), axis=-1)
    source.corrected = lambda counts, n_frames: counts - np.float32(n_frames)
    source.truth = lambda: {"scene": np.ones((4, 6))}
    source.sharp_view = lambda frame: source.frames(FrameSpan(frame, frame + 1))[0].astype(np.float32)
    return source


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any) -> Any:
        raise error

    return fail


def test_capture_reads_what_the_source_reads(source: Any) -> None:
    named = capture_of(source, ORIGIN)
    assert capture_of(named, "another") is named
    assert (named.info, named.response) == (source.info, source.response)
    assert named.valid is source.valid
    for method, given in (("counts", SPAN), ("frames", SPAN), ("packed", SPAN), ("sharp_view", 2)):
        np.testing.assert_array_equal(getattr(named, method)(given), getattr(source, method)(given))
    np.testing.assert_array_equal(named.corrected_counts(SPAN), source.counts(SPAN) - np.float32(3))
    truth = named.truth()
    assert truth is not None
    assert set(truth) == {"scene"}


def test_capture_closes_the_source(source: Any) -> None:
    closed: list[bool] = []
    source.close = lambda: closed.append(True)
    with capture_of(source, ORIGIN):
        assert not closed
    assert closed


def test_sources_of_colours_name_the_plugin_too(source: Any, memory_source: type) -> None:
    red = memory_source(source.frames(FrameSpan(0, 8)))
    red.counts = raising(OSError("gone"))
    source.colours, source.clear_mix = lambda: {"red": red}, lambda: np.ones(3)
    with pytest.raises(PluginError, match=r"toys 1\.0.* failed at frames 2 to 4: OSError: gone"):
        capture_of(source, ORIGIN).colours()["red"].counts(SPAN)


@pytest.mark.parametrize(
    ("method", "given", "where", "answer", "problem"),
    [
        ("counts", (SPAN,), "frames 2 to 4", np.zeros((6, 4)), "expected the shape (4, 6), got (6, 4)"),
        ("frames", (SPAN,), "frames 2 to 4", np.zeros((6, 4)), "expected the shape (3, 4, 6), got (6, 4)"),
        ("packed", (SPAN,), "frames 2 to 4", np.zeros((6, 4)), "expected the shape (3, 4, 1), got (6, 4)"),
        (
            "corrected",
            (np.ones((4, 6), np.uint32), 3),
            "correcting",
            np.ones((4, 6), np.uint32),
            "corrected() returns (4, 6) of float32, got (4, 6) of uint32",
        ),
        ("truth", (), "truth()", [1], "truth() returns a mapping of arrays by name, got a list"),
        (
            "sharp_view",
            (2,),
            "sharp_view()",
            np.zeros((2, 2), np.float32),
            "sharp_view() returns (4, 6) of float32, got (2, 2) of float32",
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
            getattr(capture_of(source, ORIGIN) if method == "corrected" else named, method)(*given)
        assert str(caught.value) == said


def test_errors_written_for_users_pass(source: Any) -> None:
    error = InputError("the disk was pulled out")
    source.counts = raising(error)
    with pytest.raises(InputError) as caught:
        capture_of(source, ORIGIN).counts(SPAN)
    assert caught.value is error


@pytest.mark.parametrize("method", ["counts", "frames", "packed"])
def test_array_that_changes_after_it_was_returned_is_refused(source: Any, method: str) -> None:
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


def test_values_of_later_reads_are_checked_now_and_then(source: Any) -> None:
    named, good = capture_of(source, ORIGIN), source.counts(SPAN)
    for _ in range(20):
        named.counts(SPAN)
    source.counts = lambda _: good + np.uint32(9)
    with pytest.raises(PluginError, match=r"counts\(\) returns numbers from 0 to 3 for these frames, got 1"):
        [named.counts(SPAN) for _ in range(32)]
