"""Lens distortion in the residuals of simulated captures, along the motion of the camera without its lens."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano import open_source, parse_spec
from photonpano.context import Context
from photonpano.geometry import FrameTrajectory
from photonpano.merging.canvas_plan import plan_canvas
from photonpano.merging.panorama import render
from photonpano.residuals.lens import lens_distortion
from photonpano.residuals.measure import measure
from photonpano.residuals.prediction import Predictions

SHAPE = (96, 128)


def found(k1: float):
    simulator = {
        "scene": {"kind": "street", "width": 512, "height": 341},
        "path": {"kind": "pan", "length_px": 80},
        "flux": 0.5,
        "n_frames": 800,
        "frame_shape": list(SHAPE),
        "lens": {"k1": k1},
    }
    with open_source(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}})) as source:
        motion = FrameTrajectory(source.truth()["homographies"])
        span = source.info.span
        canvas = plan_canvas(motion, span, SHAPE, 1.0, 2**30)
        panorama = render(source, motion, span, canvas, 0.25, Context())
        residuals = measure(span, Predictions.of(source, panorama, canvas, motion, SHAPE), Context())
        return lens_distortion(*residuals.block_shifts(), motion.at(np.arange(span.stop)), SHAPE)


@pytest.mark.parametrize("k1", [-0.02, 0.02])
def test_lens_distortion_is_found_with_its_sign(k1: float) -> None:
    distortion = found(k1)
    assert distortion.sigmas > 5
    # The motion is the true one, which has not followed the distortion as an estimated one does.
    assert 0.7 < distortion.k1 / k1 < 2.2


def test_lens_distortion_is_not_significant_without_a_lens() -> None:
    assert found(0.0).sigmas < 4


def test_lens_distortion_needs_blocks() -> None:
    still = np.tile(np.eye(3), (10, 1, 1))
    assert lens_distortion(np.zeros((2, 2, 2)), np.tile(np.eye(2), (2, 2, 1, 1)), still, (32, 32)) is None
