from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from photonpano import Arrived, FrameSpan, Piped
from photonpano.photometry import BinaryResponse
from photonpano.testing import MemorySource, SourceConformance
from photonpano.testing.conformance import Conformance

FRAMES = SourceConformance().known_frames()


class Honest(MemorySource):
    def __init__(self, context):
        super().__init__(FRAMES.copy())


class HasNoMask(Honest):
    def __init__(self, context):
        super().__init__(context)
        del self.valid


class PromisesMore(Honest):
    def __init__(self, context):
        super().__init__(context)
        self.info = replace(self.info, width=32)


class NotBinary(Honest):
    def frames(self, span):
        return super().frames(span) * 3


class BadPixels(Honest):
    """Its mask is true for unusable pixels."""

    def __init__(self, context):
        super().__init__(context)
        self.valid = ~self.valid


class CountsInFloat(Honest):
    def counts(self, span):
        return super().counts(span).astype(np.float32)


class CountsTooMuch(Honest):
    def counts(self, span):
        return super().counts(span) * 2


class RateOfText(Honest):
    def __init__(self, context):
        super().__init__(context)
        self.info = replace(self.info, frame_rate_hz="fast")


class NarrowCounts(Honest):
    def counts(self, span):
        return super().counts(span).astype(np.uint16)


class CountsOneMore(Honest):
    """Includes the stop of a span."""

    def counts(self, span):
        return super().counts(FrameSpan(span.start, min(span.stop + 1, self.info.n_frames)))


class CountsFromTheEnd(Honest):
    """Frames of a span come backwards."""

    def frames(self, span):
        return super().frames(span)[::-1]


class SwapsRows(Honest):
    def frames(self, span):
        return super().frames(span)[:, ::-1]


class GivesWhatThereIs(Honest):
    def counts(self, span):
        self.info.require(FrameSpan(0, 1))
        return self._frames[span.start : span.stop].sum(axis=0, dtype=np.uint32)


class LendsItsFrames(Honest):
    def frames(self, span):
        self.info.require(span)
        return self._frames[span.start : span.stop]


class ReusesItsBuffer(Honest):
    def __init__(self, context):
        super().__init__(context)
        self.buffer = np.zeros(self.info.frame_shape, np.uint32)

    def counts(self, span):
        self.buffer[:] = super().counts(span)
        return self.buffer


class Packed(Honest):
    def packed(self, span):
        return np.packbits(self.frames(span), axis=-1)


class PacksFromTheRight(Packed):
    def packed(self, span):
        return np.packbits(self.frames(span), axis=-1, bitorder="little")


class LendsPackedFrames(Packed):
    def __init__(self, context):
        super().__init__(context)
        self.kept = super().packed(self.info.span)

    def packed(self, span):
        return self.kept[span.start : span.stop]


class SharesAPosition(Honest):
    def frames(self, span):
        self.position = span.start
        time.sleep(2e-3)
        return super().frames(FrameSpan(self.position, self.position + len(span)))


class LeftToChance(Honest):
    def __init__(self, context):
        super().__init__(context)
        self.valid = np.random.Generator(np.random.get_bit_generator()).random(self.info.frame_shape) > 0.1  # the fault


class Doubled(BinaryResponse):
    def flux(self, mean_count, frames):
        return 2 * super().flux(mean_count, frames)


class Unbounded(BinaryResponse):
    def flux(self, mean_count, frames):
        with np.errstate(divide="ignore"):
            return -np.log1p(-mean_count)


class AnswersDoubled(Honest):
    def __init__(self, context):
        super().__init__(context)
        self.response = Doubled()


class AnswersUnbounded(Honest):
    def __init__(self, context):
        super().__init__(context)
        self.response = Unbounded()


class HidesErrors(Honest):
    def __exit__(self, kind, error, trace):
        return True


def finds_fault(config):
    return ["there is no file capture.npy"]


def arrived_without_the_last(config):
    return Arrived(MemorySource(FRAMES[:-1]))


def arrived_out_of_order(config):
    return Arrived(MemorySource(FRAMES[:, ::-1]))


def written(self, frames, folder):
    return {}


BROKEN = [
    ("test_source_passes_the_checks_of_a_run", RateOfText, "a run refuses the source: .*info.frame_rate_hz is a finite", {}),
    (
        "test_source_passes_the_checks_of_a_run",
        CountsInFloat,
        r"a run refuses the source: it broke its contract at frame 0: counts\(\) returns an array of whole numbers",
        {},
    ),
    ("test_source_passes_the_checks_of_a_run", CountsTooMuch, r"counts\(\) returns numbers from 0 to 1 for these frames", {}),
    ("test_source_has_required_attributes", HasNoMask, "HasNoMask has no valid", {}),
    ("test_info_agrees_with_frames", PromisesMore, r"gives the shape \(5, 18, 32\) .* returns \(5, 18, 27\)", {}),
    ("test_info_agrees_with_frames", NotBinary, "gives binary frames of 1 bits, so at most 1; frames.. returns a 3", {}),
    ("test_valid_is_bool_mask_of_frame_shape", BadPixels, "false everywhere", {}),
    ("test_counts_are_uint32_of_frame_shape", NarrowCounts, "uint32, got uint16", {}),
    (
        "test_counts_equal_sum_of_frames",
        CountsOneMore,
        r"for frame 0, \d+ pixels differ, first the one at row 0",
        {},
    ),
    (
        "test_packed_equals_packbits_of_frames",
        PacksFromTheRight,
        r"packed.span. must be numpy.packbits.* \d+ pixels differ",
        {},
    ),
    (
        "test_packed_equals_packbits_of_frames",
        LendsPackedFrames,
        "after its caller changed the array that packed.. returned",
        {},
    ),
    (
        "test_counts_of_adjacent_spans_add_up",
        CountsOneMore,
        "counts of frames 0 to 36 and of frames 37 to 74 must add up",
        {},
    ),
    ("test_frame_is_the_same_in_any_span", CountsFromTheEnd, "frame 0 of frames 0 to 74 differs from that frame alone", {}),
    ("test_frames_equal_written_frames", SwapsRows, "75 of 75 frames differ", {"write": written}),
    (
        "test_arrived_frames_are_those_of_the_capture",
        Honest,
        r"arrived\(\) has 74 binary frames of .*, and the complete capture 75 binary frames",
        {"record": {"arrived": arrived_without_the_last}},
    ),
    (
        "test_arrived_frames_are_those_of_the_capture",
        Honest,
        r"the frames of arrived\(\) must be those of the capture, but \d+ pixels differ",
        {"record": {"arrived": arrived_out_of_order}},
    ),
    (
        "test_arrived_frames_are_those_of_the_capture",
        Honest,
        r"arrived\(\) of a file must return an Arrived, got a Piped",
        {"record": {"arrived": lambda _: Piped(0, 1)}},
    ),
    (
        "test_span_beyond_capture_raises_input_error",
        GivesWhatThereIs,
        r"counts\(\) of frames 74 to 75 .* it returned a nd",
        {},
    ),
    ("test_returned_arrays_belong_to_caller", LendsItsFrames, "after its caller changed the array that frames.. returned", {}),
    ("test_returned_arrays_belong_to_caller", ReusesItsBuffer, "counts.. overwrites an array that it returned before", {}),
    (
        "test_threads_read_the_same_frames",
        SharesAPosition,
        "reading in several threads at once must not raise|are read differently",
        {},
    ),
    ("test_reopened_source_gives_same_bytes", LeftToChance, "opened again, the source returns others", {}),
    ("test_response_flux_inverts_mean_count", AnswersDoubled, "response.flux must invert response.mean_count", {}),
    ("test_response_flux_inverts_mean_count", AnswersUnbounded, r"finite flux, got \[inf\]", {}),
    ("test_with_block_returns_source_and_propagates_errors", HidesErrors, "__exit__ must not return True", {}),
    (
        "test_check_accepts_config_under_test",
        Honest,
        "must accept the capture under test; it returned: there is no file capture.npy",
        {"record": {"check": finds_fault}},
    ),
    ("test_check_rejects_wrong_configs", Honest, "check.. must reject {}; it returned no problem", {"wrong": ({},)}),
    (
        "test_check_rejects_wrong_configs",
        Honest,
        "opening a capture with {} must raise InputError; it returned a Honest",
        {"wrong": ({},), "record": {"check": finds_fault}},
    ),
]


@pytest.mark.parametrize(("check", "broken", "words", "more"), BROKEN)
def test_check_fails_on_broken_component(check, broken, words, more, catches):
    catches(SourceConformance, check, broken, words, **more)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(SourceConformance, Conformance) == {check for check, *_ in BROKEN}


@pytest.mark.parametrize(("honest", "bit_depth"), [(Honest, 1), (Packed, 1), (Honest, 10)])
def test_checks_pass_on_correct_component(honest, bit_depth, checks_of, failure):
    def build(context):
        source = honest(context)
        if bit_depth > 1:
            source._frames = subject.known_frames()
            source.info = replace(source.info, kind="intensity", bit_depth=bit_depth)
        return source

    subject = type("Deep", (SourceConformance,), {"bit_depth": bit_depth, "write": written})()
    for check in checks_of(SourceConformance, Conformance):
        assert failure(type(subject), check, build) is None, check
