"""Motion that is fast for its frames, and scenes that repeat: captures of 64x96 px with known truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano.capture.writing import truth_path
from photonpano.evaluation import corner_errors
from photonpano.specs import parse_spec

SHAPE = (64, 96)


@pytest.fixture(scope="module")
def error_px(simulated: Callable[..., Path], outcome_of: Callable) -> Callable[..., float]:
    """Run the first level on a capture, and return its mean error."""

    def error_px(group_size: int, **settings: Any) -> float:
        cube = simulated(frame_shape=list(SHAPE), **settings)
        spec = {
            "version": 1,
            "source": {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": 96800}},
            "resample": {"use": "midpoint", "with": {"group_size": group_size}},
            "levels": 1,
        }
        with np.load(truth_path(cube)) as truth:
            return corner_errors(outcome_of(parse_spec(spec)).homographies, truth["homographies"], SHAPE).mean_px

    return error_px


@pytest.mark.parametrize("defect", [False, True])
def test_first_level_does_not_lock_onto_the_next_panel(error_px: Callable, tmp_path: Path, defect: bool) -> None:
    """Groups move by 25 px, which panels of 32 px fit 7 px the other way, too."""
    rng = np.random.default_rng(0)
    panel = rng.integers(20, 255, (8, 8)).repeat(4, 0).repeat(4, 1).astype(np.uint8)
    facade = np.tile(panel, (8, 16))
    if defect:
        facade[120:136, 250:262] = 255
    cv2.imwrite(str(tmp_path / "facade.png"), facade)
    scene = {"kind": "photo", "file": str(tmp_path / "facade.png")}
    assert error_px(25, scene=scene, path={"kind": "pan", "length_px": 250}, n_frames=250, flux=0.5) < 2
