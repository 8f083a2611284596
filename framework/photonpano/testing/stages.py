"""What the components of the four stages promise beside that: they are built without data, and depend on their input alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from photonpano.contributions import StageContext, StageContribution
from photonpano.errors import CaptureUnreadError
from photonpano.photometry import BinaryResponse
from photonpano.testing.conformance import Conformance
from photonpano.values import CaptureSummary, DecisionValue, StreamInfo

STREAM = StreamInfo(2000, 254, 496, frame_rate_hz=96_800.0)
"""The capture for which a component is built, where nothing else is said."""
SUMMARY = CaptureSummary(flux=0.5, speed_px=0.15, how="as the kit says")


class StageConformance(Conformance):
    """Checks of components that are built for a capture."""

    contribution: StageContribution

    def built(self, stream: StreamInfo = STREAM, threads: int = 1) -> Any:
        """Build the component for a capture that looks like this; what the frames tell can be asked for afterwards."""
        self.require_libraries()
        working = False

        def capture() -> CaptureSummary:
            if not working:
                raise CaptureUnreadError("the component is being built, and no frame has been read")
            return SUMMARY

        context = StageContext(stream, BinaryResponse(), seed=0, threads=threads, capture=capture, decide=_decided)
        component = self.contribution.build(self.settings(), context)
        working = True
        return component

    def test_it_is_built_before_any_frame_is_read(self) -> None:
        """`photonpano check` and `explain` build components, and read no frames."""
        try:
            component = self.built()
        except CaptureUnreadError as error:
            raise AssertionError(
                "build() asks context.capture(); ask when the component works, not when it is built"
            ) from error
        self.require_methods(component)

    def test_check_finds_no_problem_with_the_config_under_test(self) -> None:
        """Problems are sentences; an empty sequence says that a run may start."""
        problems = self.contribution.check(self.settings(), STREAM)
        assert not isinstance(problems, str), f"check() returns a sequence of sentences, got the text {problems!r}"
        assert not list(problems), f"the config under test should suit {STREAM}; check() says: {'; '.join(problems)}"


def _decided(what: str, value: DecisionValue, reason: str) -> None:
    """Require of a decision that it can be recorded."""
    assert isinstance(value, bool | int | float | str), (
        f"decide() records a number, a text, true or false; the value of {what!r} is a {type(value).__name__}"
    )
    assert reason, f"decide() needs a reason for {what!r}: a clause with the numbers that decided"


@contextmanager
def unharmed(what: str) -> Iterator[None]:
    """Say what is wrong when a component that has done its work before fails with arrays that cannot be written to."""
    try:
        yield
    except Exception as error:
        raise AssertionError(
            f"{what} fails when the arrays that it is given cannot be written to; others use them as well: copy what you "
            f"change ({type(error).__name__}: {error})"
        ) from error
