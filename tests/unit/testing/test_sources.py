import time
from dataclasses import replace

import numpy as np
import pytest

from photonpano import Arrived, FrameSpan, Piped
from photonpano.photometry import BinaryResponse
from photonpano.testing import MemorySource, SourceConformance
from photonpano.testing.conformance import Conformance

from .test_behaviours import GOLDEN, check_of

FRAMES = SourceConformance().known_frames()


class Honest(MemorySource):
    def __init__(self, context):
        super().__init__(FRAMES.copy())


def having(change=lambda _: None, **methods):
    """Return a source with other methods, or with what is done to it when it is made."""

    def changed(self, context):
        Honest.__init__(self, context)
        change(self)

    for name, method in methods.items():
        method.__name__ = name  # as checks name it
    return type("Toy", (Honest,), {"__init__": changed, **methods})


def counts_as(change):
    return having(counts=lambda self, span: change(Honest.counts(self, span)))


def frames_as(change):
    return having(frames=lambda self, span: change(Honest.frames(self, span)))


def info(**fields):
    return having(lambda source: setattr(source, "info", replace(source.info, **fields)))


def bad_pixels(source):
    """Make the mask true for unusable pixels."""
    source.valid = ~source.valid


def left_to_chance(source):
    source.valid = np.random.Generator(np.random.get_bit_generator()).random(source.info.frame_shape) > 0.1  # the fault


def one_more(self, span):
    """Include the stop of a span."""
    return Honest.counts(self, FrameSpan(span.start, min(span.stop + 1, self.info.n_frames)))


def what_there_is(self, span):
    self.info.require(FrameSpan(0, 1))
    return self._frames[span.start : span.stop].sum(axis=0, dtype=np.uint32)


def lent_frames(self, span):
    self.info.require(span)
    return self._frames[span.start : span.stop]


def in_one_buffer(self, span):
    self.buffer[:] = Honest.counts(self, span)
    return self.buffer


def packing(**options):
    return having(packed=lambda self, span: np.packbits(self.frames(span), axis=-1, **options))


def at_a_shared_position(self, span):
    self.position = span.start
    time.sleep(2e-3)
    return Honest.frames(self, FrameSpan(self.position, self.position + len(span)))


class Doubled(BinaryResponse):
    def flux(self, mean_count, frames):
        return 2 * super().flux(mean_count, frames)


class Unbounded(BinaryResponse):
    def flux(self, mean_count, frames):
        with np.errstate(divide="ignore"):
            return -np.log1p(-mean_count)


def answering(response):
    return having(lambda source: setattr(source, "response", response))


def finds_fault(config):
    return ["there is no file capture.npy"]


def written(self, frames, folder):
    return {}


PACKED = packing()
BUFFERED = having(lambda source: setattr(source, "buffer", np.zeros(source.info.frame_shape, np.uint32)), counts=in_one_buffer)
LENT = having(
    lambda source: setattr(source, "kept", np.packbits(source._frames, axis=-1)),
    packed=lambda self, span: self.kept[span.start : span.stop],
)
ONE_MORE = having(counts=one_more)
# By the check that finds each, and behind a comma what is broken; what is said of each stands in behaviours.txt.
BROKEN = {
    "source_passes_the_checks_of_a_run, rate of text": info(frame_rate_hz="fast"),
    "source_passes_the_checks_of_a_run, counts in float": counts_as(lambda counts: counts.astype(np.float32)),
    "source_passes_the_checks_of_a_run, counts twice": counts_as(lambda counts: counts * 2),
    "source_has_required_attributes": having(lambda source: delattr(source, "valid")),
    "info_agrees_with_frames, another width": info(width=32),
    "info_agrees_with_frames, not binary": frames_as(lambda frames: frames * 3),
    "valid_is_bool_mask_of_frame_shape": having(bad_pixels),
    "counts_are_uint32_of_frame_shape": counts_as(lambda counts: counts.astype(np.uint16)),
    "counts_equal_sum_of_frames": ONE_MORE,
    "packed_equals_packbits_of_frames, from the right": packing(bitorder="little"),
    "packed_equals_packbits_of_frames, lent": LENT,
    "counts_of_adjacent_spans_add_up": ONE_MORE,
    "frame_is_the_same_in_any_span": frames_as(lambda frames: frames[::-1]),
    "frames_equal_written_frames": frames_as(lambda frames: frames[:, ::-1]),
    "arrived_frames_are_those_of_the_capture, fewer": Honest,
    "arrived_frames_are_those_of_the_capture, out of order": Honest,
    "arrived_frames_are_those_of_the_capture, a pipe": Honest,
    "span_beyond_capture_raises_input_error": having(counts=what_there_is),
    "returned_arrays_belong_to_caller, lent": having(frames=lent_frames),
    "returned_arrays_belong_to_caller, in one buffer": BUFFERED,
    "threads_read_the_same_frames": having(frames=at_a_shared_position),
    "reopened_source_gives_same_bytes": having(left_to_chance),
    "response_flux_inverts_mean_count, doubled": answering(Doubled()),
    "response_flux_inverts_mean_count, infinite": answering(Unbounded()),
    "with_block_returns_source_and_propagates_errors": having(__exit__=lambda *_: True),
    "check_accepts_config_under_test": Honest,
    "check_rejects_wrong_configs, accepts": Honest,
    "check_rejects_wrong_configs, opens": Honest,
}
# What else is broken: the contribution, or attributes of the class of the kit.
MORE = {
    "frames_equal_written_frames": {"write": written},
    "arrived_frames_are_those_of_the_capture, fewer": {
        "record": {"arrived": lambda _: Arrived(MemorySource(FRAMES[:-1]))},
    },
    "arrived_frames_are_those_of_the_capture, out of order": {
        "record": {"arrived": lambda _: Arrived(MemorySource(FRAMES[:, ::-1]))},
    },
    "arrived_frames_are_those_of_the_capture, a pipe": {"record": {"arrived": lambda _: Piped(0, 1)}},
    "check_accepts_config_under_test": {"record": {"check": finds_fault}},
    "check_rejects_wrong_configs, accepts": {"wrong": ({},)},
    "check_rejects_wrong_configs, opens": {"wrong": ({},), "record": {"check": finds_fault}},
}


@pytest.mark.parametrize("name", BROKEN)
def test_check_fails_on_broken_component(name, catches):
    catches(SourceConformance, check_of(name), BROKEN[name], GOLDEN[f"source, {name}"], **MORE.get(name, {}))


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(SourceConformance, Conformance) == set(map(check_of, BROKEN))


@pytest.mark.parametrize(("honest", "bit_depth"), [(Honest, 1), (PACKED, 1), (Honest, 10)])
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
