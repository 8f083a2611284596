"""What resamplers promise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

from photonpano.contributions import ResamplerContribution
from photonpano.errors import InputError
from photonpano.testing.stages import STREAM, StageConformance
from photonpano.values import Group

LEVELS = (1, 2, 3, 4)
LONG = (STREAM.n_frames, STREAM.n_frames + 37)
"""A capture that the config suits, and one whose length divides by little."""
SHORT = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)


class ResamplerConformance(StageConformance):
    """Checks of a resampler, for captures of about 2,000 frames and for short ones.

    Attributes:
        contribution: what is tested.
        config: keys that suit a capture of 2,000 frames.
    """

    kind: ClassVar[str] = "resampler"
    methods: ClassVar[tuple[str, ...]] = ("groups",)

    contribution: ResamplerContribution

    def groups(self, n_frames: int, level: int) -> Any:
        """Ask a resampler that has just been built."""
        return self.built(replace(STREAM, n_frames=n_frames)).groups(n_frames, level)

    def _everywhere(self) -> Iterator[tuple[str, int, Any]]:
        for n_frames in LONG:
            for level in LEVELS:
                yield f"level {level} of {n_frames} frames", n_frames, self.groups(n_frames, level)

    def test_groups_are_a_tuple_that_is_not_empty(self) -> None:
        """A level without groups has nothing to locate; a generator could be read only once."""
        for where, _, groups in self._everywhere():
            assert isinstance(groups, tuple), f"groups() returns a tuple of Group; at {where} it is a {type(groups).__name__}"
            assert groups, f"at {where} there is no group; a capture that is too short is an InputError"
            strangers = {type(group).__name__ for group in groups if not isinstance(group, Group)}
            assert not strangers, f"groups() returns Group objects; at {where} there are {', '.join(strangers)}"

    def test_groups_come_in_the_order_of_their_reference_instants(self) -> None:
        """An interpolator needs instants that increase; one that came twice would be located twice."""
        for where, _, groups in self._everywhere():
            for before, after in pairwise(groups):
                assert before.reference < after.reference, (
                    f"reference instants must increase; at {where}, {before.reference} is followed by {after.reference}"
                )

    def test_groups_lie_inside_the_capture(self) -> None:
        """A source refuses a span that it does not hold."""
        for where, n_frames, groups in self._everywhere():
            last = max(groups, key=lambda group: group.span.stop)
            assert last.span.stop <= n_frames, f"at {where}, a group reaches beyond the last frame: {last}"

    def test_the_reference_instant_lies_inside_the_span(self) -> None:
        """An exposure is seen from an instant that its frames show."""
        for where, _, groups in self._everywhere():
            for group in groups:
                assert group.span.start <= group.reference <= group.span.stop - 1, (
                    f"the reference lies between the first and the last frame; at {where} it is {group.reference} of {group}"
                )

    def test_spans_are_whole_python_numbers(self) -> None:
        """Groups are written to `run.json`, which holds no numbers of numpy."""
        for where, _, groups in self._everywhere():
            kinds = {type(end).__name__ for group in groups for end in (group.span.start, group.span.stop)}
            assert kinds == {"int"}, f"spans hold Python's int; at {where} there is {', '.join(sorted(kinds - {'int'}))}"

    def test_the_same_question_has_the_same_answer(self) -> None:
        """Also when levels are asked for in another order, as the estimate of memory does."""
        for n_frames in LONG:
            together = self.built(replace(STREAM, n_frames=n_frames))
            backwards = {level: together.groups(n_frames, level) for level in reversed(LEVELS)}
            for level in LEVELS:
                for again in (backwards[level], together.groups(n_frames, level)):
                    assert again == self.groups(n_frames, level), (
                        f"groups({n_frames}, {level}) must depend on nothing but its arguments, the config and the seed; "
                        "asked once more, or after other levels, it gave other groups"
                    )

    def test_a_short_capture_gives_groups_or_an_input_error(self) -> None:
        """Users see the sentence of an InputError; anything else is reported as a defect of the plugin."""
        for n_frames in SHORT:
            try:
                groups = self.groups(n_frames, 1)
            except InputError:
                continue
            except Exception as error:
                raise AssertionError(
                    f"a capture that is too short is an InputError; with {n_frames} frames, groups() raised "
                    f"{type(error).__name__}: {error}"
                ) from error
            assert groups, f"with {n_frames} frames there is no group; a capture that is too short is an InputError"
            assert groups[-1].span.stop <= n_frames, f"with {n_frames} frames, a group is {groups[-1]}"

    def test_check_foresees_that_a_capture_is_too_short(self) -> None:
        """`photonpano check` tells it before anything runs."""
        for n_frames in SHORT:
            stream = replace(STREAM, n_frames=n_frames)
            problems = list(self.contribution.check(self.settings(), stream))
            try:
                self.groups(n_frames, 1)
                refused = None
            except InputError as error:
                refused = error
            assert bool(problems) == (refused is not None), (
                f"check() and groups() must agree about {n_frames} frames; check() says {'; '.join(problems) or 'nothing'}, "
                f"groups() {f'raises InputError: {refused}' if refused else 'gives groups'}"
            )
