"""Checks of resamplers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any, ClassVar

from photonpano.contracts.loop import GROUPS
from photonpano.errors import InputError
from photonpano.plugins.contributions import ResamplerContribution
from photonpano.testing.stages import STREAM, Answer, AnswerConformance

LEVELS = (1, 2, 3, 4)
LONG = (STREAM.n_frames, STREAM.n_frames + 37)  # lengths of captures that suit the config, one of them with few divisors
SHORT = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)


class ResamplerConformance(AnswerConformance):
    """Checks of a resampler, for captures of about 2,000 frames and for short ones.

    Attributes:
        config: the keys under `with`, which must suit a capture of 2,000 frames.
    """

    kind: ClassVar[str] = "resampler"
    contracts = (GROUPS,)

    contribution: ResamplerContribution

    def groups(self, n_frames: int, level: int) -> Any:
        """Return the groups of a new resampler."""
        return self.built(replace(STREAM, n_frames=n_frames)).groups(n_frames, level)

    def answers(self) -> Iterator[Answer]:
        """Yield the groups of several levels and captures."""
        for n_frames in LONG:
            for level in LEVELS:
                groups = tuple(islice(self.groups(n_frames, level), 2 * n_frames))
                yield f"the groups of level {level} of {n_frames} frames", GROUPS, groups, n_frames

    def test_groups_returns_tuple(self) -> None:
        """A generator could be read only once."""
        for n_frames in LONG:
            groups = self.groups(n_frames, 1)
            assert isinstance(groups, tuple), (
                f"groups() must return a tuple of Group; at level 1 of {n_frames} frames it returned a {type(groups).__name__}"
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
