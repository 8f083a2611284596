from __future__ import annotations

import itertools
from itertools import count

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError
from photonpano.testing import ResamplerConformance
from photonpano.testing.conformance import Conformance
from photonpano.testing.stages import StageConformance


class Honest:
    """Groups of 100 frames, one after the other."""

    def __init__(self, context):
        self.calls = itertools.count()

    def groups(self, n_frames, level):
        if n_frames < 100:
            raise InputError(f"{n_frames} frames are too few")
        spans = (FrameSpan(start, start + 100) for start in range(0, n_frames - 99, 100))
        return tuple(Group(span, span.centre) for span in spans)


class AGenerator(Honest):
    def groups(self, n_frames, level):
        return (group for group in super().groups(n_frames, level))


class WithoutEnd(Honest):
    def groups(self, n_frames, level):
        return (Group(FrameSpan(start, start + 1), start) for start in count())


class Backwards(Honest):
    def groups(self, n_frames, level):
        return super().groups(n_frames, level)[::-1]


class Twice(Honest):
    def groups(self, n_frames, level):
        return (groups := super().groups(n_frames, level))[:1] + groups


class Beyond(Honest):
    def groups(self, n_frames, level):
        return (*super().groups(n_frames, level), Group(FrameSpan(n_frames - 50, n_frames + 50), n_frames))


class SeenFromElsewhere(Honest):
    def groups(self, n_frames, level):
        groups = super().groups(n_frames, level)
        object.__setattr__(groups[-1], "reference", n_frames + 5.0)
        return groups


class NumbersOfNumpy(Honest):
    def groups(self, n_frames, level):
        return tuple(
            Group(FrameSpan(np.int64(group.span.start), group.span.stop), group.reference)
            for group in super().groups(n_frames, level)
        )


class Forgetful(Honest):
    def groups(self, n_frames, level):
        return super().groups(n_frames, level)[: -1 if next(self.calls) else None]


class ShortIsADefect(Honest):
    def groups(self, n_frames, level):
        return super().groups(n_frames, level) if n_frames >= 100 else (Group(FrameSpan(0, n_frames // 2), 0),)


class NothingForShort(Honest):
    def groups(self, n_frames, level):
        return super().groups(n_frames, level) if n_frames >= 100 else ()


BROKEN = [
    (
        "test_groups_pass_the_checks_of_a_run",
        WithoutEnd,
        "a run refuses the groups of level 1 of 2000 frames: the capture has 2000 frames, got 4000 groups or more",
    ),
    (
        "test_groups_returns_non_empty_tuple",
        AGenerator,
        "must return a tuple of Group; at level 1 of 2000 frames it returned a gener",
    ),
    (
        "test_groups_are_ordered_by_reference",
        Backwards,
        r"at level 1 of 2000 frames, 1949.5 is followed by",
    ),
    ("test_groups_are_ordered_by_reference", Twice, r"49.5 is followed by 49.5"),
    ("test_groups_lie_inside_capture", Beyond, "a group reaches beyond the last frame: frames 1950 to 2049"),
    ("test_reference_lies_inside_span", SeenFromElsewhere, "it is 2005.0 for frames 1900 to 1999"),
    (
        "test_spans_are_python_integers",
        NumbersOfNumpy,
        "spans must consist of Python's int; at level 1 of 2000 frames there is int64",
    ),
    ("test_groups_depend_on_arguments_only", Forgetful, r"groups\(2000, 1\) must depend on its arguments"),
    ("test_short_capture_gives_groups_or_input_error", ShortIsADefect, "with 1 frames it raised ValueError"),
    ("test_short_capture_gives_groups_or_input_error", NothingForShort, "no group for 1 frames"),
    (
        "test_check_agrees_with_groups_about_short_captures",
        Honest,
        "check.. returns no problem, groups.. raises InputError: 1 frames",
    ),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_check_fails_on_broken_component(check, broken, words, catches):
    catches(ResamplerConformance, check, broken, words)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(ResamplerConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_checks_pass_on_correct_component(checks_of, failure):
    def foreseen(config, stream):
        return ["too short"] if stream.n_frames < 100 else []

    for check in checks_of(ResamplerConformance, Conformance):
        assert failure(ResamplerConformance, check, Honest, record={"check": foreseen}) is None, check
