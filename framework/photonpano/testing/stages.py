"""Checks of all components but sources: they are built before frames are read, and accept read-only inputs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeAlias

import pytest

from photonpano.contracts.rules import Contract, Rule
from photonpano.errors import CaptureUnreadError
from photonpano.photometry import BinaryResponse
from photonpano.plugins.contributions import StageContext, StageContribution
from photonpano.testing.conformance import Conformance
from photonpano.values import CaptureSummary, DecisionValue, StreamInfo

STREAM = StreamInfo(2000, 254, 496, frame_rate_hz=96_800.0)  # the capture for which components are built by default
SUMMARY = CaptureSummary(flux=0.5, speed_px=0.15, how="set by the conformance kit")
# What a component returned, described for messages; its contract; the value; and the facts for the contract.
Answer: TypeAlias = tuple[str, Contract[Any], Any, Any]


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


class AnswerConformance(StageConformance):
    """Checks of components whose answers have a contract: one check for each of its rules."""

    contracts: ClassVar[tuple[Contract[Any], ...]]
    _verdicts: ClassVar[tuple[str, list[tuple[str, Rule]]]]

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrise the check of the contract with its rules."""
        if "rule" in metafunc.fixturenames:
            rules = self.rules()
            metafunc.parametrize("rule", rules, ids=[re.sub("{.*?}", "_", sentence) for sentence, _ in rules])

    @classmethod
    def rules(cls) -> list[Rule]:
        """Return the rules of all contracts, each once."""
        return list(dict.fromkeys(rule for contract in cls.contracts for rule in (*contract.rules, *contract.strict)))

    def answers(self) -> Iterator[Answer]:
        """Yield what the component returns for several inputs."""
        raise NotImplementedError

    def test_answers_keep_the_contract(self, rule: Rule) -> None:
        """See `photonpano.contracts`: a run refuses what breaks most of these rules, and converts or ignores the rest."""
        for complaint, broken in self._complaints():
            kept = broken is not rule
            assert kept, complaint

    def _complaints(self) -> list[tuple[str, Rule]]:
        """Return what is wrong with each answer that breaks a rule; the component is called once for all rules."""
        key, kept = repr(self.config), type(self).__dict__.get("_verdicts")
        if kept is None or kept[0] != key:
            kept = type(self)._verdicts = key, []
            for what, contract, found, facts in self.answers():
                if broken := contract.first_broken(found, facts):
                    refused = f"a run refuses {what}" if broken[0] in contract.rules else f"{what} breaks the contract"
                    kept[1].append((f"{refused}: {broken[1]}", broken[0]))
        return kept[1]


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
