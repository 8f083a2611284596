"""Checks of sources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Arrived, PackedSource, Source
from photonpano.errors import InputError
from photonpano.plugins.contributions import SourceContext, SourceContribution
from photonpano.testing.conformance import Conformance, must_not_raise, passing
from photonpano.testing.sameness import fingerprint, global_seed, in_threads
from photonpano.values import FrameSpan, StreamInfo

_MAX_FRAMES = 200  # frames that are checked, half of them at each end of a longer capture


class SourceConformance(Conformance):
    """Checks of a source.

    Attributes:
        config: the keys under `with` of a small capture; those that `write` returns are added.
        frame_shape: (height, width) of the frames that `write` is given; choose an odd width if the format supports it.
        n_frames: number of these frames.
        bit_depth: bits per pixel of these frames.
        wrong: keys that replace those of the config and that `check` must reject, such as a missing file.
        grows: whether this capture can be read while it is being written, if the contribution has an `arrived`.
    """

    kind: ClassVar[str] = "source"
    attributes: ClassVar[tuple[str, ...]] = ("info", "response", "valid", "__enter__", "__exit__")

    contribution: SourceContribution
    frame_shape: tuple[int, int] = (18, 27)
    n_frames: int = 75
    bit_depth: int = 1
    wrong: Sequence[Mapping[str, Any]] = ()
    grows: bool = True

    def write(self, frames: NDArray[np.generic], folder: Path) -> Mapping[str, Any]:
        """Write frames as a capture and return the keys that open it; override this for a source that reads files.

        Args:
            frames: (n_frames, *frame_shape), uint8, or uint16 for a bit depth of more than 8.
            folder: an empty folder for the files.
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

    def test_source_has_required_attributes(self) -> None:
        """See `photonpano.Source`."""
        with self.opened() as source:
            self.require_methods(source)

    def test_info_agrees_with_frames(self) -> None:
        """Memory is planned and components are built from `info`, before any frame is read."""
        with self.opened() as source:
            info = source.info
            assert isinstance(info, StreamInfo), f"info must be a StreamInfo, got a {type(info).__name__}"
            sizes = {type(size).__name__ for size in (info.n_frames, info.height, info.width)}
            assert sizes == {"int"}, f"sizes must be Python's int, for the record of a run; got {', '.join(sorted(sizes))}"
            shape, wanted = source.frames(_first(source)).shape, (len(_first(source)), *info.frame_shape)
            assert shape == wanted, f"info gives the shape {wanted} for {len(_first(source))} frames; frames() returns {shape}"
            values = source.frames(_first(source))
            highest = 1 if info.kind == "binary" else 2**info.bit_depth - 1
            assert values.dtype.kind in "u", f"frames must be unsigned integers, got {values.dtype}"
            assert values.max() <= highest, (
                f"info gives {info.kind} frames of {info.bit_depth} bits, so at most {highest}; "
                f"frames() returns a {values.max()}"
            )

    def test_valid_is_bool_mask_of_frame_shape(self) -> None:
        """It is true for usable pixels."""
        with self.opened() as source:
            mask, info = source.valid, source.info
            assert mask.shape == info.frame_shape, f"valid must have the shape {info.frame_shape}, got {mask.shape}"
            assert mask.dtype == np.bool_, f"valid must be bool, got {mask.dtype}"
            some = bool(mask.any())
            assert some, "valid is false everywhere; it must be true for usable pixels"

    def test_source_passes_the_checks_of_a_run(self) -> None:
        """A run refuses properties of other types, numbers that frames cannot have, and arrays that change later."""
        with self.opened() as source, passing("the source"):
            named = capture_of(source, "it")
            for span in _spans(source):
                named.counts(span)
                named.frames(span)

    def test_counts_are_uint32_of_frame_shape(self) -> None:
        """Sums of many frames fit and can be added without a cast."""
        with self.opened() as source:
            counts, info = source.counts(_first(source)), source.info
            assert counts.shape == info.frame_shape, f"counts() must return the shape {info.frame_shape}, got {counts.shape}"
            assert counts.dtype == np.uint32, f"counts() must return uint32, got {counts.dtype}"

    def test_counts_equal_sum_of_frames(self) -> None:
        """For any span, also of one frame."""
        with self.opened() as source:
            for span in _spans(source):
                difference = _difference(source.counts(span), source.frames(span).sum(axis=0, dtype=np.uint32))
                assert not difference, f"counts(span) must be the sum of frames(span); for {span}, {difference}"

    def test_packed_equals_packbits_of_frames(self) -> None:
        """For a `photonpano.PackedSource`; the array belongs to the caller."""
        with self.opened() as source:
            if not isinstance(source, PackedSource):
                return
            for span in _spans(source):
                packed, expected = source.packed(span), np.packbits(source.frames(span), axis=-1)
                assert packed.dtype == np.uint8, f"packed() must return uint8, got {packed.dtype}"
                difference = _difference(packed, expected)
                assert not difference, f"packed(span) must be numpy.packbits(frames(span), axis=-1); for {span}, {difference}"
                packed[...] = 255
                difference = _difference(source.packed(span), expected)
                assert not difference, (
                    f"after its caller changed the array that packed() returned, it returns other frames: {difference}"
                )

    def test_counts_of_adjacent_spans_add_up(self) -> None:
        """Spans are half-open: `[start, stop)`."""
        with self.opened() as source:
            for span in _spans(source):
                if len(span) == 1:
                    continue
                middle = (span.start + span.stop) // 2
                parts = FrameSpan(span.start, middle), FrameSpan(middle, span.stop)
                difference = _difference(source.counts(parts[0]) + source.counts(parts[1]), source.counts(span))
                assert not difference, (
                    f"a span must contain its start and not its stop; counts of {parts[0]} and of {parts[1]} must "
                    f"add up to those of {span}, but {difference}"
                )

    def test_frame_is_the_same_in_any_span(self) -> None:
        """Frame i of the capture is frame i - start of a span."""
        with self.opened() as source:
            for span in _spans(source):
                together = source.frames(span)
                for index in sorted({0, len(span) // 2, len(span) - 1}):
                    frame = span.start + index
                    difference = _difference(together[index], source.frames(FrameSpan(frame, frame + 1))[0])
                    assert not difference, (
                        f"frames(span)[i] must be frame span.start + i; frame {frame} of {span} differs from that frame alone: "
                        f"{difference}"
                    )

    def test_frames_equal_written_frames(self) -> None:
        """Rows, columns and bits are in their places, and no frame is missing."""
        if type(self).write is SourceConformance.write:
            pytest.skip("write() is not overridden, so the frames of this source are unknown")
        known = self.known_frames()
        with self.opened() as source:
            shape = (source.info.n_frames, *source.info.frame_shape)
            assert shape == known.shape, f"{known.shape} (frames, height, width) were written; info gives {shape}"
            read = source.frames(source.info.span)
            wrong = [index for index in range(len(known)) if _difference(read[index], known[index])]
            assert not wrong, (
                f"{len(wrong)} of {len(known)} frames differ from those that were written; in frame {wrong[0]}, "
                f"{_difference(read[wrong[0]], known[wrong[0]])}"
            )

    def test_arrived_frames_are_those_of_the_capture(self) -> None:
        """Of a capture that is complete, all frames have arrived; a source that cannot be followed has no `arrived`."""
        if self.contribution.arrived is None or not self.grows:
            return
        found = self.contribution.arrived(self.settings())
        assert isinstance(found, Arrived), f"arrived() of a file must return an Arrived, got a {type(found).__name__}"
        assert found.source is not None, "arrived() of a complete capture must have its frames"
        with self.opened() as whole, found.source as source:
            assert source.info == whole.info, f"arrived() has {source.info}, and the complete capture {whole.info}"
            assert found.promised in (None, whole.info.n_frames), f"arrived() promises {found.promised} frames"
            difference = _difference(source.counts(_first(source)), whole.counts(_first(whole)))
            assert not difference, f"the frames of arrived() must be those of the capture, but {difference}"

    def test_span_beyond_capture_raises_input_error(self) -> None:
        """Missing frames are neither invented nor silently left out."""
        with self.opened() as source:
            n_frames = source.info.n_frames
            for span in (FrameSpan(n_frames - 1, n_frames + 1), FrameSpan(n_frames, n_frames + 1)):
                for method in (source.counts, source.frames):
                    outcome = _outcome_of(method, span)
                    assert outcome == "InputError", (
                        f"{method.__name__}() of {span} of a capture with {n_frames} frames must raise InputError, as "
                        f"`self.info.require(span)` does; it {outcome}"
                    )

    def test_returned_arrays_belong_to_caller(self) -> None:
        """The caller may keep and change them."""
        with self.opened() as source:
            span = _first(source)
            for method in (source.counts, source.frames):
                first = method(span)
                kept = first.copy()
                method(FrameSpan(max(0, source.info.n_frames - 5), source.info.n_frames))
                difference = _difference(first, kept)
                assert not difference, f"{method.__name__}() overwrites an array that it returned before; return a new array"
                if first.flags.writeable:
                    first[...] = 0
                difference = _difference(method(span), kept)
                assert not difference, (
                    f"after its caller changed the array that {method.__name__}() returned, it returns other values; "
                    "return a copy"
                )

    def test_threads_read_the_same_frames(self) -> None:
        """Groups are merged concurrently."""
        with self.opened() as source:
            spans = _spans(source)

            def read(first: int) -> dict[FrameSpan, object]:
                """Start with another span in each thread."""
                order = spans[first:] + spans[:first]
                return {span: fingerprint((source.counts(span), source.frames(span))) for span in order}

            expected = read(0)
            for found in must_not_raise("reading in several threads at once", in_threads, read):
                wrong = [str(span) for span in spans if found[span] != expected[span]]
                assert not wrong, (
                    f"when several threads read at once, {', '.join(wrong)} are read differently; do the threads share a file "
                    "position or a buffer?"
                )

    def test_reopened_source_gives_same_bytes(self) -> None:
        """A run can be repeated; random numbers follow from the seed of the context."""
        seen = []
        for seed in (1, 2):
            with global_seed(seed), self.opened() as source:
                seen.append([fingerprint((source.info, source.valid, source.frames(span))) for span in _spans(source)])
        assert seen[0] == seen[1], "the same config and seed must give the same frames; opened again, the source returns others"

    def test_response_flux_inverts_mean_count(self) -> None:
        """`response.flux(response.mean_count(flux))` equals the flux, up to that of a saturated pixel."""
        with self.opened() as source:
            frames = 10_000
            lit = source.response.flux(source.response.mean_count(np.array([1e9], np.float32)), frames)
            assert np.isfinite(lit[0]), f"a saturated pixel must have a finite flux, got {lit.tolist()}"
            flux = np.minimum(np.array([0.0, 0.01, 0.3, 1.0, 2.0, np.nan], np.float32), lit)
            again = source.response.flux(source.response.mean_count(flux), frames)
            inverted = np.allclose(again, flux, rtol=1e-3, atol=1e-5, equal_nan=True)
            assert inverted, (
                f"response.flux must invert response.mean_count, and keep NaN; {flux.tolist()} becomes {again.tolist()}"
            )

    def test_with_block_returns_source_and_propagates_errors(self) -> None:
        """Runs use `with build(...) as source:`."""
        hidden = True
        try:
            with self.opened() as entered:
                self.require_methods(entered)
                raise LookupError("an error of the caller")
        except LookupError:
            hidden = False
        assert not hidden, "__exit__ must not return True: it suppressed an error that was raised inside of `with`"

    def test_check_accepts_config_under_test(self) -> None:
        """`check` returns a sequence of sentences, empty if there is no problem."""
        problems = self.contribution.check(self.settings())
        assert not isinstance(problems, str), f"check() must return a sequence of sentences, got the text {problems!r}"
        assert not list(problems), f"check() must accept the capture under test; it returned: {'; '.join(problems)}"

    def test_check_rejects_wrong_configs(self) -> None:
        """`photonpano check` reports them before a run."""
        for keys in self.wrong:
            settings = self.contribution.config.model_validate({**self.config, **keys})
            assert list(self.contribution.check(settings)), f"check() must reject {dict(keys)}; it returned no problem"
            outcome = _outcome_of(lambda each: self.contribution.build(each, SourceContext()), settings)
            assert outcome == "InputError", f"opening a capture with {dict(keys)} must raise InputError; it {outcome}"


def _outcome_of(work: Any, argument: Any) -> str:
    try:
        result = work(argument)
    except InputError:
        return "InputError"
    except Exception as error:
        return f"raised {type(error).__name__}: {error}"
    return f"returned a {type(result).__name__}"


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


def _difference(found: NDArray[np.generic], expected: NDArray[np.generic]) -> str:
    """Describe where two arrays differ; an empty text if they do not."""
    if found.shape != expected.shape:
        return f"shapes are {found.shape} and {expected.shape}"
    places = np.argwhere(found != expected)
    if not len(places):
        return ""
    row, column = places[0][-2:]
    return (
        f"{len(places)} pixels differ, first the one at row {row}, column {column}: "
        f"{found[tuple(places[0])]} instead of {expected[tuple(places[0])]}"
    )
