"""Tests of what was captured, and of the camera that the spec gives."""

from __future__ import annotations

from photonpano.motion.timeline import INTERLACED, SHOTS, SHUFFLED
from photonpano.residuals.tested_run import TestedRun, Tests
from photonpano.values.verdict import Found

CAPTURE_TESTS = Tests()


@CAPTURE_TESTS.doubtful_above(
    1,
    "the capture holds shots that no pair of exposures ties together, and the panorama is of the longest alone",
    "look at the panoramas of the others beside the run folder: DIR.panorama-2 and so on",
)
def _shots(run: TestedRun) -> Found | None:
    shots = next((str(each.value) for each in run.decisions if each.what == SHOTS), "")
    return Found(shots.count("frame"), shots) if shots else None


@CAPTURE_TESTS.doubtful_above(
    0.5,
    "odd and even frames show two different images, as where two captures are interlaced",
    "write each capture to a file of its own",
)
def _interlaced(run: TestedRun) -> Found | None:
    return run.decided(INTERLACED, "share of the image in which they differ")


@CAPTURE_TESTS.doubtful_above(
    0.05,
    "the image jumps back and forth from one frame to the next, as where frames are out of order",
    "sort the frames by the time at which they were taken",
)
def _shuffled(run: TestedRun) -> Found | None:
    return run.decided(SHUFFLED, "share of the width of a frame, the median of the jumps")


@CAPTURE_TESTS.doubtful_above(
    10,
    "the photons contradict the focal length or the lens that the spec gives",
    "write camera: {focal_px: find}, and distortion: {k1: find} if the lens distorts, or calibrate the camera anew",
)
def _given_camera(run: TestedRun) -> Found | None:
    freed = run.levels[-1].located.solution.freed() if run.levels else None
    if freed is None:
        return None
    what, unit = [("a focal length", " px"), ("k1", "")][freed.number]
    where = f"{what} of {freed.found:.4g} ± {freed.std:.2g}{unit} fits, {freed.given:.4g}{unit} is given; in expected errors"
    return Found(abs(freed.found - freed.given) / freed.std, where)
