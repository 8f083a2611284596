"""What a pass proposes is accepted if it explains the photons no worse; the state before is kept otherwise."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, LocationError
from photonpano.context import Context
from photonpano.errors import CanvasTooLargeError
from photonpano.motion.timeline import Cut, Timeline
from photonpano.pipeline.passes.cuts import Cuts
from photonpano.pipeline.passes.levels import LaterLevels
from photonpano.pipeline.passes.light import ChangingLight
from photonpano.pipeline.passes.rule import Pass, tried
from photonpano.pipeline.state import State
from photonpano.specs import parse_spec
from photonpano.testing import MemorySource

PLAN = parse_spec({"version": 1, "source": {"use": "simulator"}})
BEFORE = State(PLAN, None, Context(), 0, (), Timeline.regular(9))


class Toy(Pass[str]):
    """Proposes what it is given, or raises it."""

    severity = logging.WARNING

    def __init__(self, proposal: Any, worse: str = "", compared: bool = True) -> None:
        self._proposal, self._worse, self.compared = proposal, worse, compared

    def find(self, state: State) -> str | None:
        return "something"

    def propose(self, state: State, found: str) -> State | None:
        if isinstance(self._proposal, Exception):
            raise self._proposal
        return self._proposal

    def worse(self, proposed: State, state: State) -> str:
        return self._worse

    def settled(self, proposed: State, state: State) -> State:
        return replace(proposed, reference=5)


AFTER = replace(BEFORE, reference=4)


@pytest.mark.parametrize(
    ("step", "accepted", "worse"),
    [
        (Toy(AFTER), True, ""),
        (Toy(AFTER, "it grew"), False, "it grew"),
        (Toy(AFTER, "it grew", compared=False), True, ""),
        (Toy(None), False, ""),
        (Toy(LocationError("lost")), False, "lost"),
        (Toy(CanvasTooLargeError("too large")), False, "too large"),
    ],
)
def test_proposal_is_accepted_if_not_worse(step: Toy, accepted: bool, worse: str, caplog: pytest.LogCaptureFixture) -> None:
    trial = tried(BEFORE, step)
    assert (trial.accepted, trial.worse, trial.found) == (accepted, worse, "something")
    assert trial.state.reference == (5 if accepted else 0)
    assert caplog.messages == ([f"Toy: {worse}"] if worse else [])


def test_pass_that_finds_nothing_proposes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Toy, "find", lambda *_: None)
    assert tried(BEFORE, Toy(AFTER)).state is BEFORE


def test_errors_of_passes_that_are_not_compared_end_the_run() -> None:
    with pytest.raises(LocationError, match="lost"):
        tried(BEFORE, Toy(LocationError("lost"), compared=False))


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
    tried(replace(BEFORE, source=source, levels=levels, results=(first,), outdated=outdated), LaterLevels([]))
    assert ran == [(located, first.trajectory)]


def fitted(misfit: float, **more: Any) -> Any:
    """A state whose steps scatter more than those of any other."""
    return SimpleNamespace(fit=SimpleNamespace(misfit=misfit, worse_than=lambda _: "the scatter grew"), **more)


@pytest.mark.parametrize(("misfit", "worse"), [(1.5, ""), (2.9, "the scatter grew")])
def test_scatter_of_steps_counts_only_if_light_does_not_lower_misfit(misfit: float, worse: str) -> None:
    assert ChangingLight(PLAN).worse(fitted(misfit), fitted(3.0)) == worse


@pytest.mark.parametrize(("dark", "worse"), [(None, "the scatter grew"), (FrameSpan(3, 6), "")])
def test_cut_among_dark_frames_is_not_compared(dark: FrameSpan | None, worse: str) -> None:
    cut = Cut(4, np.array([3.0, 0.0]), 9.0, dark)
    proposed = fitted(1.0, timeline=Timeline.regular(9).cut_at([cut]))
    assert Cuts().worse(proposed, fitted(1.0)) == worse
    assert Cuts().rejection((cut,), "it grew") == (
        "the image seems to jump before frame 4, but the motion is not cut there: it grew"
    )
