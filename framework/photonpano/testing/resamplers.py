"""Checks of resamplers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

from photonpano.contributions import ResamplerContribution
from photonpano.errors import InputError
from photonpano.motion.checks import require_groups
from photonpano.testing.conformance import passing
from photonpano.testing.stages import STREAM, StageConformance
from photonpano.values import Group

LEVELS = (1, 2, 3, 4)
LONG = (STREAM.n_frames, STREAM.n_frames + 37)
"""Lengths of captures that suit the config, one of them with few divisors."""
SHORT = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)


class ResamplerConformance(StageConformance):
    """Checks of a resampler, for captures of about 2,000 frames and for short ones.

    Attributes:
        contribution: the contribution under test.
        config: the keys under `with`, which must suit a capture of 2,000 frames.
    """

    kind: ClassVar[str] = "resampler"

    contribution: ResamplerContribution

    def groups(self, n_frames: int, level: int) -> Any:
        """Return the groups of a new resampler."""
        return self.built(replace(STREAM, n_frames=n_frames)).groups(n_frames, level)

    def _cases(self) -> Iterator[tuple[str, int, Any]]:
        for n_frames in LONG:
            for level in LEVELS:
                yield f"level {level} of {n_frames} frames", n_frames, self.groups(n_frames, level)

    def test_groups_returns_non_empty_tuple(self) -> None:
        """A level needs a group to locate, and a generator could be read only once."""
        for where, _, groups in self._cases():
            assert isinstance(groups, tuple), (
                f"groups() must return a tuple of Group; at {where} it returned a {type(groups).__name__}"
            )
            assert groups, f"groups() returned no group at {where}; raise an InputError if a capture is too short"
            strangers = {type(group).__name__ for group in groups if not isinstance(group, Group)}
            assert not strangers, f"groups() must return Group objects; at {where} it returned {', '.join(strangers)}"

    def test_groups_pass_the_checks_of_a_run(self) -> None:
        """A run refuses groups without end, without order, or outside of the capture."""
        for n_frames in LONG:
            for level in LEVELS:
                with passing(f"the groups of level {level} of {n_frames} frames"):
                    require_groups(self.groups(n_frames, level), n_frames)

    def test_groups_are_ordered_by_reference(self) -> None:
        """Interpolators need increasing instants."""
        for where, _, groups in self._cases():
            for before, after in pairwise(groups):
                assert before.reference < after.reference, (
                    f"reference instants must increase; at {where}, {before.reference} is followed by {after.reference}"
                )

    def test_groups_lie_inside_capture(self) -> None:
        """Sources refuse spans beyond the capture."""
        for where, n_frames, groups in self._cases():
            last = max(groups, key=lambda group: group.span.stop)
            assert last.span.stop <= n_frames, f"at {where}, a group reaches beyond the last frame: {last}"

    def test_reference_lies_inside_span(self) -> None:
        """The reference instant of an exposure is one of its frames, or between two."""
        for where, _, groups in self._cases():
            for group in groups:
                assert group.span.start <= group.reference <= group.span.stop - 1, (
                    f"the reference must lie between the first and the last frame; at {where} it is "
                    f"{group.reference} for {group}"
                )

    def test_spans_are_python_integers(self) -> None:
        """Groups are written to `run.json`, which cannot contain numpy integers."""
        for where, _, groups in self._cases():
            kinds = {type(end).__name__ for group in groups for end in (group.span.start, group.span.stop)}
            assert kinds == {"int"}, (
                f"spans must consist of Python's int; at {where} there is {', '.join(sorted(kinds - {'int'}))}"
            )

    def test_groups_depend_on_arguments_only(self) -> None:
        """They do not depend on the order of calls."""
        for n_frames in LONG:
            together = self.built(replace(STREAM, n_frames=n_frames))
            backwards = {level: together.groups(n_frames, level) for level in reversed(LEVELS)}
            for level in LEVELS:
                for again in (backwards[level], together.groups(n_frames, level)):
                    assert again == self.groups(n_frames, level), (
                        f"groups({n_frames}, {level}) must depend on its arguments, the config and the seed only; a second "
                        "call, or one after other levels, returned other groups"
                    )

    def test_short_capture_gives_groups_or_input_error(self) -> None:
        """An InputError is shown to users as it is; any other error is reported as a defect of the plugin."""
        for n_frames in SHORT:
            try:
                groups = self.groups(n_frames, 1)
            except InputError:
                continue
            except Exception as error:
                raise AssertionError(
                    f"groups() must raise an InputError if a capture is too short; with {n_frames} frames it raised "
                    f"{type(error).__name__}: {error}"
                ) from error
            assert groups, f"groups() returned no group for {n_frames} frames; raise an InputError if a capture is too short"
            assert groups[-1].span.stop <= n_frames, f"with {n_frames} frames, a group lies beyond the end: {groups[-1]}"

    def test_check_agrees_with_groups_about_short_captures(self) -> None:
        """`photonpano check` reports captures that are too short before a run."""
        for n_frames in SHORT:
            stream = replace(STREAM, n_frames=n_frames)
            problems = list(self.contribution.check(self.settings(), stream))
            try:
                self.groups(n_frames, 1)
                outcome = "returns groups"
            except InputError as error:
                outcome = f"raises InputError: {error}"
            assert bool(problems) == (outcome != "returns groups"), (
                f"check() and groups() must agree about {n_frames} frames; check() returns "
                f"{'; '.join(problems) or 'no problem'}, groups() {outcome}"
            )
