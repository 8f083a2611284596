"""What a pass proposes is accepted if it explains the photons no worse; the state before is kept otherwise."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, LocationError
from photonpano.context import Context
from photonpano.errors import CanvasTooLargeError
from photonpano.motion.timeline import Cut, Timeline
from photonpano.pipeline.passes import Pass, Proposal, cut_at_jumps, later_levels, tried, worse_in_light
from photonpano.pipeline.state import State
from photonpano.residuals.refinement import MotionFit
from photonpano.specs import parse_spec
from photonpano.testing import MemorySource

PLAN = parse_spec({"version": 1, "source": {"use": "simulator"}})
BEFORE = State(PLAN, None, Context(), 0, (), Timeline.regular(9))


AFTER = replace(BEFORE, reference=4)


def propose(proposal: Any, worse: str = "", compared: bool = True) -> Callable[[State], Proposal]:
    """Make a pass that proposes a state, or raises an error."""

    def make() -> State | None:
        if isinstance(proposal, Exception):
            raise proposal
        return proposal

    def settle(proposed: State) -> State:
        return replace(proposed, reference=5)

    compare = (lambda *_: worse) if compared else None
    return lambda _: Proposal(make, compare, settle, "it is not used", logging.WARNING)


@pytest.mark.parametrize(
    ("step", "accepted", "worse"),
    [
        (propose(AFTER), True, ""),
        (propose(AFTER, "it grew"), False, "it grew"),
        (propose(AFTER, "it grew", compared=False), True, ""),
        (propose(None), False, ""),
        (propose(LocationError("lost")), False, "lost"),
        (propose(CanvasTooLargeError("too large")), False, "too large"),
        (lambda _: None, False, ""),
    ],
)
def test_proposal_is_accepted_if_not_worse(
    step: Pass, accepted: bool, worse: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(State, "fit", None)
    trial = tried(BEFORE, step)
    assert (trial.accepted, trial.worse) == (accepted, worse)
    assert trial.state.reference == (5 if accepted else 0)
    assert caplog.messages == ([f"it is not used: {worse}"] if worse else [])


def test_errors_of_proposals_that_are_not_compared_end_the_run() -> None:
    with pytest.raises(LocationError, match="lost"):
        tried(BEFORE, propose(LocationError("lost"), compared=False))


@pytest.mark.parametrize(
    ("n_levels", "outdated", "located"), [(1, False, []), (1, True, [1]), (3, False, [2, 3]), (3, True, [2, 3])]
)
def test_single_level_is_located_again_if_the_capture_was_corrected_since(
    n_levels: int, outdated: bool, located: list[int], make_level: Callable, pan: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[list[int], Any]] = []

    def run(state: State, levels: Any, previous: Any) -> State:
        ran.append(([level.number for level in levels], previous))
        return state

    monkeypatch.setattr(State, "located", run)
    levels = tuple(make_level(pan(0.3), number=number) for number in range(1, n_levels + 1))
    first = SimpleNamespace(trajectory=pan(0.3))
    source: Any = MemorySource(np.zeros((9, 8, 16)))
    tried(replace(BEFORE, source=source, levels=levels, results=(first,), outdated=outdated), partial(later_levels, journal=[]))
    assert ran == [(located, first.trajectory)]


@pytest.mark.parametrize(("misfit", "worse"), [(1.5, ""), (2.9, "the scatter grew")])
def test_scatter_of_steps_counts_only_if_light_does_not_lower_misfit(misfit: float, worse: str) -> None:
    proposed, before = (SimpleNamespace(misfit=each, worse_than=lambda _: "the scatter grew") for each in (misfit, 3.0))
    assert worse_in_light(proposed, before) == worse


@pytest.mark.parametrize(("dark", "worse"), [(None, "the scatter grew"), (FrameSpan(3, 6), "")])
def test_cut_among_dark_frames_is_not_compared(dark: FrameSpan | None, worse: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cut = Cut(4, np.array([3.0, 0.0]), 9.0, dark)
    monkeypatch.setattr("photonpano.pipeline.passes.find_cuts", lambda *_: (cut,))
    monkeypatch.setattr(MotionFit, "worse_than", lambda *_: "the scatter grew")
    monkeypatch.setattr(State, "fit", None)
    proposal = cut_at_jumps(BEFORE)
    assert proposal.worse(None, None) == worse
    assert proposal.rejection == "the image seems to jump before frame 4, but the motion is not cut there"
