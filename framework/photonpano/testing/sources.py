"""Checks of sources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Arrived, PackedSource, Source
from photonpano.errors import InputError
from photonpano.plugins.contributions import SourceContext, SourceContribution
from photonpano.testing.conformance import Conformance, fingerprint, global_seed, in_threads, passing
from photonpano.values import FrameSpan

_MAX_FRAMES = 200  # frames that are checked, half of them at each end of a longer capture


class SourceConformance(Conformance):
    """Checks of a source. The config is that of a small capture; the keys that `write` returns are added."""

    kind: ClassVar[str] = "source"

    contribution: SourceContribution
    # (height, width) of the frames that `write` is given; choose an odd width if the format supports it
    frame_shape: tuple[int, int] = (18, 27)
    n_frames: int = 75  # number of these frames
    bit_depth: int = 1  # bits per pixel of these frames
    wrong: Sequence[Mapping[str, Any]] = ()  # keys that replace those of the config and that `check` must reject
    grows: bool = True  # whether this capture can be read while it is being written, if the contribution has an `arrived`

    def write(self, frames: NDArray[np.generic], folder: Path) -> Mapping[str, Any]:
        """Write frames as a capture and return the keys that open it; override this for a source that reads files.

        They are (n_frames, *frame_shape), uint8, or uint16 for a bit depth of more than 8; the folder is empty.
        """
        del frames, folder
        return {}

    def known_frames(self) -> NDArray[np.generic]:
        """Return the frames that `write` is given."""
        shape = (self.n_frames, *self.frame_shape)
        values = np.random.default_rng(0).integers(0, 2**self.bit_depth, shape)
        return values.astype(np.uint8 if self.bit_depth <= 8 else np.uint16)

    @pytest.fixture(autouse=True)
    def _capture(self, tmp_path: Path) -> None:
        self.prepare(tmp_path)

    def prepare(self, folder: Path) -> None:
        """Write the capture under test."""
        self.config = {**self.config, **self.write(self.known_frames(), folder)}

    def opened(self) -> Source:
        """Open the capture under test; close it with `with`."""
        self.require_libraries()
        return self.contribution.build(self.settings(), SourceContext(seed=0, threads=2))

    def test_source_passes_the_checks_of_a_run(self) -> None:
        """A run refuses wrong properties, arrays of another shape or type, and numbers that frames cannot have."""
        with self.opened() as source, passing("the source"):
            named = capture_of(source, "it")
            for span in _spans(source):
                named.counts(span)
                named.frames(span)

    def test_counts_equal_sum_of_frames(self) -> None:
        """For any span, also of one frame."""
        with self.opened() as source:
            for span in _spans(source):
                counts = source.counts(span)
                assert counts.dtype == np.uint32
                assert_array_equal(counts, source.frames(span).sum(axis=0, dtype=np.uint32), f"counts of {span}")

    def test_packed_equals_packbits_of_frames(self) -> None:
        """For a `photonpano.PackedSource`; the array belongs to the caller."""
        with self.opened() as source:
            if not isinstance(source, PackedSource):
                return
            for span in _spans(source):
                packed, expected = source.packed(span), np.packbits(source.frames(span), axis=-1)
                assert_array_equal(packed, expected, f"packed() is numpy.packbits(frames(), axis=-1), for {span}")
                packed[...] = 255
                assert_array_equal(source.packed(span), expected, "packed() must return a new array")

    def test_frame_is_the_same_in_any_span(self) -> None:
        """Frame i of the capture is frame i - start of a span, which is half-open: [start, stop)."""
        with self.opened() as source:
            for span in _spans(source):
                together = source.frames(span)
                for index in sorted({0, len(span) // 2, len(span) - 1}):
                    alone = source.frames(FrameSpan(span.start + index, span.start + index + 1))[0]
                    assert_array_equal(together[index], alone, f"frame {index} of {span} is frame {span.start + index}")

    def test_frames_equal_written_frames(self) -> None:
        """Rows, columns and bits are in their places, and no frame is missing."""
        if type(self).write is SourceConformance.write:
            pytest.skip("write() is not overridden, so the frames of this source are unknown")
        with self.opened() as source:
            assert_array_equal(source.frames(source.info.span), self.known_frames(), "frames() are those that were written")

    def test_arrived_frames_are_those_of_the_capture(self) -> None:
        """Of a capture that is complete, all frames have arrived; a source that cannot be followed has no `arrived`."""
        if self.contribution.arrived is None or not self.grows:
            return
        found = self.contribution.arrived(self.settings())
        assert isinstance(found, Arrived)
        assert found.source is not None, "arrived() of a complete capture must have its frames"
        with self.opened() as whole, found.source as source:
            assert source.info == whole.info
            assert found.promised in (None, whole.info.n_frames)
            assert_array_equal(source.counts(_first(source)), whole.counts(_first(whole)), "frames of arrived()")

    def test_span_beyond_capture_raises_input_error(self) -> None:
        """Missing frames are neither invented nor silently left out; `self.info.require(span)` raises it."""
        with self.opened() as source:
            n_frames = source.info.n_frames
            for span in (FrameSpan(n_frames - 1, n_frames + 1), FrameSpan(n_frames, n_frames + 1)):
                for method in (source.counts, source.frames):
                    with pytest.raises(InputError):
                        method(span)

    def test_returned_arrays_belong_to_caller(self) -> None:
        """The caller may keep and change them."""
        with self.opened() as source:
            span = _first(source)
            for method in (source.counts, source.frames):
                first: NDArray[Any] = method(span)
                kept = first.copy()
                method(FrameSpan(max(0, source.info.n_frames - 5), source.info.n_frames))
                assert_array_equal(first, kept, f"{method.__name__}() overwrites an array that it returned before")
                if first.flags.writeable:
                    first[...] = 0
                assert_array_equal(method(span), kept, f"{method.__name__}() must return a copy")

    def test_threads_read_the_same_frames(self) -> None:
        """Groups are merged concurrently. Threads that share a file position or a buffer fail here."""
        with self.opened() as source:
            spans = _spans(source)

            def read(first: int) -> dict[FrameSpan, object]:
                """Start with another span in each thread."""
                order = spans[first:] + spans[:first]
                return {span: fingerprint((source.counts(span), source.frames(span))) for span in order}

            expected = read(0)
            for found in in_threads(read):
                assert found == expected, "several threads that read at once read other frames than one"

    def test_reopened_source_gives_same_bytes(self) -> None:
        """A run can be repeated; random numbers follow from the seed of the context."""
        seen = []
        for seed in (1, 2):
            with global_seed(seed), self.opened() as source:
                seen.append([fingerprint((source.info, source.valid, source.frames(span))) for span in _spans(source)])
        assert seen[0] == seen[1], "the same config and seed must give the same frames"

    def test_with_block_propagates_errors(self) -> None:
        """Runs use `with build(...) as source:`, and `__exit__` must not suppress an error of the caller."""
        error = LookupError("an error of the caller")
        with pytest.raises(LookupError), self.opened():
            raise error

    def test_check_accepts_config_under_test(self) -> None:
        """`check` returns a sequence of sentences, empty if there is no problem."""
        assert [*self.contribution.check(self.settings())] == []

    def test_check_rejects_wrong_configs(self) -> None:
        """`photonpano check` reports them before a run."""
        for keys in self.wrong:
            settings = self.contribution.config.model_validate({**self.config, **keys})
            assert [*self.contribution.check(settings)], f"check() must reject {dict(keys)}"
            with pytest.raises(InputError):
                self.contribution.build(settings, SourceContext())


def _first(source: Source) -> FrameSpan:
    return FrameSpan(0, min(source.info.n_frames, 5))


def _spans(source: Source) -> list[FrameSpan]:
    """Return spans of one and of many frames, at both ends and in between."""
    stop = source.info.n_frames
    half = min(stop, _MAX_FRAMES // 2)
    middle = half // 2
    return [
        FrameSpan(0, 1),
        FrameSpan(stop - 1, stop),
        FrameSpan(middle, middle + 1),
        FrameSpan(0, half),
        FrameSpan(half // 3, max(2 * half // 3, half // 3 + 1)),
        FrameSpan(stop - half, stop),
    ]
