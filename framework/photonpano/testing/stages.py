"""Checks of all components but sources: they are built before frames are read, and accept read-only inputs."""

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
"""The capture for which components are built by default."""
SUMMARY = CaptureSummary(flux=0.5, speed_px=0.15, how="set by the conformance kit")


class StageConformance(Conformance):
    """Checks of components that are built for a capture."""

    contribution: StageContribution

    def built(self, stream: StreamInfo = STREAM, threads: int = 1) -> Any:
        """Build the component for a capture; its summary is available only afterwards."""
        self.require_libraries()
        capture = _Summary()
        context = StageContext(stream, BinaryResponse(), seed=0, threads=threads, capture=capture, decide=_decided)
        component = self.contribution.build(self.settings(), context)
        capture.available = True
        return component

    def test_build_reads_no_frames(self) -> None:
        """`photonpano check` and `explain` build components without reading frames."""
        try:
            component = self.built()
        except CaptureUnreadError as error:
            raise AssertionError("build() calls context.capture(); call it later, when the component is used") from error
        self.require_methods(component)

    def test_check_accepts_config_under_test(self) -> None:
        """`check` returns a sequence of sentences, empty if there is no problem."""
        problems = self.contribution.check(self.settings(), STREAM)
        assert not isinstance(problems, str), f"check() must return a sequence of sentences, got the text {problems!r}"
        assert not list(problems), f"check() must accept the config under test for {STREAM}; it returned: {'; '.join(problems)}"


class _Summary:
    """The summary of the capture, once the component is built."""

    available = False

    def __call__(self) -> CaptureSummary:
        if not self.available:
            raise CaptureUnreadError("no frame has been read while the component is being built")
        return SUMMARY


def _decided(what: str, value: DecisionValue, reason: str) -> None:
    """Check that a decision can be recorded."""
    assert isinstance(value, bool | int | float | str), (
        f"decide() needs a number, a text or a bool; the value of {what!r} is a {type(value).__name__}"
    )
    assert reason, f"decide() needs a reason for {what!r}: a clause with the numbers behind it"


@contextmanager
def accepts_read_only(what: str) -> Iterator[None]:
    """Fail with a message if a component, which worked before, fails with read-only arrays."""
    try:
        yield
    except Exception as error:
        raise AssertionError(
            f"{what} fails with read-only arrays; other components share them, so copy an array before you change it "
            f"({type(error).__name__}: {error})"
        ) from error
