"""Tests of the motion: its errors, and the decisions that led to it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from photonpano.motion.loop import TOO_NARROW
from photonpano.motion.timeline import DARK_JUMP, UNCUT_JUMP
from photonpano.residuals.scene_tests import of_either_part
from photonpano.residuals.tested_run import FIND_LENS, FREE, RIVAL, TestedRun, Tests
from photonpano.values import Reason
from photonpano.values.verdict import Found

REPEATS = "the scene repeats, and pairs of exposures fit at several places"
NARROW = "the camera moves by more than the model of its motion holds"
_UNCERTAIN_PX = 1.0
_ASLANT = 5.0  # ratio of the errors along two directions beyond which one of them is unknown

MOTION_TESTS = Tests()


@MOTION_TESTS.doubtful_above(1.0, "no motion is known", "use smaller groups, or more light")
def _unknown(run: TestedRun) -> Found | None:
    known = run.explained.motion.std_px[run.explained.motion.located]
    if of_either_part(run) or (len(known) and np.isfinite(known).all()):
        return None
    return Found(0.0, "a single exposure was located", doubtful=True)


@MOTION_TESTS.doubtful_above(
    _UNCERTAIN_PX,
    "the image says nothing of motion along one direction",
    "the motion may be wrong by any distance along it, which this panorama does not show; keep other structures in view",
)
def _one_direction(run: TestedRun) -> Found | None:
    halves = run.explained.halves
    if not len(halves.cuts):
        return None
    weakest = int(np.argmax(halves.std_px[:, 1]))
    (strong, weak), angle = halves.std_px[weakest].tolist(), halves.angles_deg[weakest]
    if weak < _ASLANT * strong:
        return None
    where = f"px between the frames before and after {halves.cuts[weakest]:.0f}, at {angle:.0f} degrees from x towards y"
    return Found(weak, f"{where}; {strong:.2g} px across it")


@MOTION_TESTS.doubtful_above(
    _UNCERTAIN_PX,
    "the expected error of the motion is large",
    "use more light; where few pairs tie parts together, more of them (graph.skips, graph.tie)",
)
def _uncertain(run: TestedRun) -> Found | None:
    motion = run.explained.motion
    known = motion.std_px[motion.located]
    # Where two motions are possible, or a direction is not seen, no light tells which.
    alternatives = {RIVAL, UNCUT_JUMP} & {each.what for each in run.decisions}
    if not len(known) or not np.isfinite(known).all() or alternatives or _one_direction.judged(run):
        return None
    worst = int(np.argmax(np.where(motion.located, motion.std_px, 0)))
    where, change_px = f"px on average, most at frame {worst}", run.levels[-1].change_px if run.levels else None
    if change_px is not None and change_px > _UNCERTAIN_PX:
        where += f"; the last level changed the motion by {change_px:.2g} px"
        return Found(float(known.mean()), where, what_to_do="let it converge: use smaller groups, or levels: until-converged")
    return Found(float(known.mean()), where)


@MOTION_TESTS.doubtful_above(
    0.1,
    "pairs of exposures contradict each other, as where a scene repeats",
    "look at the path in the report; use a slower motion, or smaller groups",
)
def _contradictions(run: TestedRun) -> Found | None:
    return None if run.pairs is None else _contradicting(*run.pairs)


def _contradicting(dropped: int, pairs: int) -> Found:
    return Found(dropped / max(pairs, 1), f"{dropped} of {pairs} pairs of the last level")


def contradictions(dropped: int, pairs: int) -> Reason | None:
    """Judge the pairs of the last level, of which some, `dropped`, contradict the others."""
    return _contradictions.reason(_contradicting(dropped, pairs))


@MOTION_TESTS.doubtful_above(TOO_NARROW, NARROW, FREE)
def _narrow(run: TestedRun) -> Found | None:
    """Homographies are likelier, and farther away than the motion is expected to err."""
    if not run.levels or not (times := run.levels[-1].narrow):
        return None
    located, motion = run.levels[-1].located, run.explained.motion
    model = located.solution.model
    apart_px = located.rivals["homography"].apart_px
    where = f"times the expected error lie between {model.name} and any homographies, which are likelier: {apart_px:.2g} px"
    finds = model.kind == "rotation" and not (motion.camera is not None and motion.camera.distorts)
    what_to_do = f"{FREE}, or {FIND_LENS}" if finds else ""
    return Found(times, where, what_to_do=what_to_do)


@MOTION_TESTS.doubtful_above(0.05, REPEATS, "look at the path in the report; a slower motion tells the places apart")
def _ambiguous(run: TestedRun) -> Found | None:
    def found() -> Iterator[Found]:
        for result in run.levels:
            ambiguity, n_edges = result.located.ambiguity, len(result.located.edges)
            # One or two pairs may be ambiguous by their noise.
            if ambiguity is not None and len(ambiguity.pairs) > 2:
                of_level = f"{len(ambiguity.pairs)} of {n_edges} pairs of level {result.level.number}"
                yield Found(len(ambiguity.pairs) / max(n_edges, 1), f"{of_level}, {ambiguity.alternative_px:.0f} px away")

    return max(found(), key=lambda each: each.figure > 0.05, default=None)


@MOTION_TESTS.doubtful_above(
    0,
    "the image jumps while frames show nothing, so that it is unknown where they lie, and whether frames are missing",
    "leave these frames out, or keep the light on",
)
def _jump_in_the_dark(run: TestedRun) -> Found:
    found = [str(each.value) for each in run.decisions if each.what == DARK_JUMP]
    return Found(len(found), ", ".join(found))


@MOTION_TESTS.doubtful_above(
    1.0,
    "the image seems to jump, but the photons contradict a cut of the motion there",
    "look at the path in the report around this frame; use a slower motion, or smaller groups",
)
def _uncut_jump(run: TestedRun) -> Found | None:
    return run.decided(UNCUT_JUMP)


def second_place_px(run: TestedRun) -> float:
    """Return how far away the second place of a scene that repeats is, in px; 0 where pairs fit at one place."""
    ambiguities = [each.located.ambiguity for each in run.levels]
    return max(each.alternative_px for each in ambiguities if each) if _ambiguous.judged(run) else 0.0
