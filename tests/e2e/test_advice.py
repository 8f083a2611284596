"""The advice of a doubtful run: a capture that provokes it, the advice followed, and a run that is better."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import evaluate, parse_spec, run
from photonpano.capture.writing import truth_path

pytestmark = pytest.mark.usefixtures("without_report")

PAN: dict[str, Any] = {"kind": "pan", "length_px": 60, "angle_deg": 17}
TURN = {"kind": "turn", "degrees": 40, "pitch_wobble_deg": 5}
SHIFTS = {"motion": {"model": "translation"}, "resample": {"with": {"group_size": 40}}}
LONG_GROUPS = SHIFTS | {"resample": {"with": {"group_size": 100}}, "refine": []}
# What the simulator is told; the spec; what is doubtful; the advice; and the spec that follows it.
ADVICE: dict[str, tuple[dict[str, Any], dict[str, Any], str, str, dict[str, Any]]] = {
    "refiner": (
        {"path": PAN | {"shake": {"rms_px": 2, "frequencies_hz": [700, 1100]}}, "n_frames": 500},
        LONG_GROUPS,
        "the image moves within groups by more than the motion that was found",
        "use the refiner short-spans",
        LONG_GROUPS | {"refine": ["short-spans"]},
    ),
    "light": (
        {"path": PAN, "lamps": [{"frequency_hz": 600, "depth": 0.6}]},
        {"light": "steady"} | SHIFTS,
        "the light changes over time",
        "write light: auto",
        {"light": "auto"} | SHIFTS,
    ),
    "lens": (
        {"path": TURN, "focal_length_px": 200, "distortion": {"k1": -0.3}, "frame_shape": [96, 144], "n_frames": 400},
        {"motion": {"model": "homography"}},
        "the lens distorts the frames, which bends the motion",
        "write motion: {model: rotation} and camera: {distortion: {k1: find}}",
        {"motion": {"model": "rotation"}, "camera": {"distortion": {"k1": "find"}}},
    ),
    "focal length": (
        {"path": TURN, "focal_length_px": 150},
        {"motion": {"model": "rotation"}, "camera": {"focal_px": 250}, "levels": 2},
        "the photons contradict the focal length or the lens that the spec gives",
        "write camera: {focal_px: find}",
        {"motion": {"model": "rotation"}, "camera": {"focal_px": "find"}, "levels": 2},
    ),
}


@pytest.mark.parametrize("case", ADVICE)
def test_advice_that_is_followed_helps(case: str, simulated: Callable[..., Path], tmp_path: Path) -> None:
    settings, spec, what, advice, followed = ADVICE[case]
    capture = simulated(**{"frame_shape": [80, 128], "n_frames": 300} | settings)
    base = {"version": 1, "source": {"use": "packed-npy", "with": {"path": str(capture), "frame_rate_hz": 96800}}, "levels": 1}
    doubtful, better = (
        run(parse_spec(base | each, output=tmp_path / name)) for name, each in (("before", spec), ("after", followed))
    )
    assert doubtful.verdict is not None
    assert better.verdict is not None
    assert advice in {reason.what: reason.what_to_do for reason in (*doubtful.verdict.reasons, *doubtful.verdict.notes)}[what]
    assert better.verdict.status == "trusted"
    scores = [evaluate(each.directory, truth_path(capture), oracle=False) for each in (doubtful, better)]
    before_px, after_px = (float(np.mean(score.trajectory.errors_px)) for score in scores)
    assert after_px < 0.5 * before_px
