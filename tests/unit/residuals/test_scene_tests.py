"""Whether the motion is that of the scene: what stands, what is left out, and the grain of a sensor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from photonpano.residuals.refinement import Explained
from photonpano.residuals.verdict import judge
from photonpano.values import Decision


def test_background_that_is_mostly_hidden_is_doubtful(explained: Explained) -> None:
    """A thing that fills the middle of all frames passes for the scene, and what is seen beside it for what hides that."""
    found = [judge(explained, (), [Decision("movers", share, "")]).reasons for share in (0.48, 0.52)]
    assert [[reason.figure for reason in reasons] for reasons in found] == [[], [0.52]]


def test_a_third_that_is_left_out_may_be_the_scene_if_as_much_of_the_rest_changes(explained: Explained) -> None:
    changing = replace(explained.residuals, cell_chi2=np.full_like(explained.residuals.cell_chi2, 9))
    verdicts = [judge(each, (), [Decision("movers", 0.33, "")]) for each in (explained, replace(explained, residuals=changing))]
    named = [[reason.what.startswith("much of what the frames show") for reason in verdict.reasons] for verdict in verdicts]
    assert named == [[], [True, False]]


@pytest.mark.parametrize(("grain", "moves_px", "doubtful"), [(1, 0, True), (0, 0, False), (1, 3, False)])
def test_image_that_stands_still_is_doubtful_if_it_has_the_grain_of_a_sensor(
    explained: Explained, grain: float, moves_px: float, doubtful: bool
) -> None:
    rng, shape = np.random.default_rng(1), explained.residuals.frame_shape
    pattern = grain * rng.normal(0, 0.1, shape) + 3 * ndimage.gaussian_filter(rng.normal(0, 0.3, shape), 3)
    homographies = explained.motion.homographies.copy()
    homographies[:, 0, 2] = np.linspace(0, moves_px, len(homographies))
    residuals = replace(explained.residuals, pixel_mean=np.float32(1000 * np.clip(1 + pattern, 0.1, 2)))
    still = replace(explained, motion=replace(explained.motion, homographies=homographies), residuals=residuals)
    whats = [reason.what for reason in judge(still, ()).reasons]
    assert ("the image stands still, and has the fine grain of a sensor whose pixels differ" in whats) is doubtful
