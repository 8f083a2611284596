"""The verdict: each test finds the residuals that were made for it, and nothing else; photon noise is trusted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano.motion.graph import Evidence
from photonpano.residuals.block_sums import GX_R, GXX, GY_R, GYY, M, R
from photonpano.residuals.refinement import Explained
from photonpano.residuals.verdict import NO_TURN, Reason, contradictions, judge
from photonpano.values import Ambiguity


def with_residuals(explained: Explained, **changes: Any) -> Explained:
    return replace(explained, residuals=replace(explained.residuals, **changes))


def only_reason(explained: Explained) -> Reason:
    verdict = judge(explained, ())
    assert verdict.status == "doubtful"
    [reason] = verdict.reasons
    assert reason.figure > reason.threshold
    assert reason.what_to_do
    return reason


def test_photon_noise_is_trusted(explained: Explained) -> None:
    verdict = judge(explained, ())
    assert (verdict.status, verdict.reasons, verdict.residual_ratio) == ("trusted", (), 1.05)


@pytest.mark.parametrize(("rotation", "gain", "doubtful"), [(1.2, 1.1, False), (25.0, 3.0, True), (4.0, 40.0, True)])
def test_rotations_that_do_not_explain_the_pairs_are_doubtful(
    explained: Explained, rotation: float, gain: float, doubtful: bool
) -> None:
    """Either the residuals are large, or those of homographies are much smaller."""
    evidence = Evidence(rotation, 1.0, gain)
    solution = SimpleNamespace(turns=object(), outliers=())
    level = SimpleNamespace(located=SimpleNamespace(solution=solution, evidence=evidence, edges=(), ambiguity=None))
    reasons = judge(explained, [level]).reasons
    assert [reason.what for reason in reasons] == [NO_TURN] * doubtful
    if doubtful:
        assert reasons[0].figure == np.sqrt(rotation)


def test_unknown_ratio_is_trusted_and_none(explained: Explained) -> None:
    verdict = judge(replace(explained, ratio=float("nan")), ())
    assert (verdict.status, verdict.residual_ratio) == ("trusted", None)


def test_large_misfit_is_doubtful(explained: Explained) -> None:
    reason = only_reason(with_residuals(explained, misfit=explained.residuals.misfit + 2))
    assert reason.what.startswith("the panorama does not explain the photons")
    assert reason.figure == pytest.approx(3, abs=0.05)
    # 2 variances of 100 photons beyond the noise: sqrt(200) of 100 photons.
    assert reason.where == "on average by 14% of the light"


def test_misfit_of_many_photons_is_trusted_if_it_is_little_light(explained: Explained) -> None:
    """With 10,000 times the photons, a misfit of 1.5 is 0.07 % of the light."""
    found = with_residuals(explained, misfit=explained.residuals.misfit + 0.5, blocks=1e4 * explained.residuals.blocks)
    assert judge(found, ()).status == "trusted"


def test_place_that_changes_over_time_is_doubtful_and_named(explained: Explained) -> None:
    cells = explained.residuals.cell_misfit.copy()
    cells[2:6, 10:16] = 9
    reason = only_reason(with_residuals(explained, cell_misfit=cells))
    assert reason.what.startswith("parts of the panorama change over time")
    assert reason.figure == pytest.approx(24 / 300)
    assert reason.where == "mostly x 160 to 256, y 32 to 96 in px of the panorama"


def test_place_that_changes_by_little_light_is_trusted(explained: Explained) -> None:
    """A misfit of 9 where the noise is 1 % of the light is a change by 3 %."""
    cells, noise = explained.residuals.cell_misfit.copy(), explained.residuals.cell_noise.copy()
    cells[2:6, 10:16], noise[2:6, 10:16] = 9, 1e-4
    assert judge(with_residuals(explained, cell_misfit=cells, cell_noise=noise), ()).status == "trusted"


def test_place_that_few_blocks_saw_is_not_judged(explained: Explained) -> None:
    cells, counts = explained.residuals.cell_misfit.copy(), explained.residuals.cell_count.copy()
    cells[2:6, 10:16], counts[2:6, 10:16] = 9, 3
    assert judge(with_residuals(explained, cell_misfit=cells, cell_count=counts), ()).status == "trusted"


def test_scatter_of_shifts_beyond_noise_is_doubtful(explained: Explained) -> None:
    reason = only_reason(replace(explained, ratio=24.0))
    assert reason.what == "the image moves within groups by more than the motion that was found"
    assert reason.figure == 24


def test_light_that_changes_is_doubtful_and_its_frames_are_named(explained: Explained) -> None:
    residuals = explained.residuals
    gains = np.zeros(len(residuals.spans))
    gains[50:60], gains[55] = 0.2, 0.4
    gradient = residuals.gradient + gains[:, None] * residuals.normal[:, :, 4]
    reason = only_reason(with_residuals(explained, gradient=gradient))
    assert reason.what == "the light changes over time"
    assert reason.figure == pytest.approx(np.sqrt(np.mean(gains**2)), rel=0.05)
    assert reason.where == "most at frames 550 to 559"


def test_dark_corner_of_sensor_is_doubtful_and_named(explained: Explained) -> None:
    blocks = explained.residuals.blocks.copy()
    blocks[:3, :4, R] -= 0.15 * blocks[:3, :4, M]
    blocks[1, 2, R] -= 0.1 * blocks[1, 2, M]
    reason = only_reason(with_residuals(explained, blocks=blocks))
    assert reason.what.startswith("parts of the sensor count more or fewer photons than others")
    assert reason.where == "most at pixel (40, 24) of the frame"


def test_hot_and_dead_pixels_are_doubtful_and_counted(explained: Explained) -> None:
    gain = explained.residuals.pixel_gain.copy()
    gain[3, :100], gain[100, :100] = 8, 0
    reason = only_reason(with_residuals(explained, pixel_gain=gain))
    assert reason.what.startswith("single pixels count far more, or far fewer, photons")
    assert (reason.figure, reason.where) == (pytest.approx(200 / gain.size), "200 pixels")


def test_radial_shifts_are_doubtful_as_a_deformation(explained: Explained) -> None:
    """A lens shifts a block by up to 1 px, outward, with the cube of its distance from the middle."""
    blocks = explained.residuals.blocks.copy()
    rows, columns = blocks.shape[:2]
    y, x = np.mgrid[:rows, :columns] - np.array([(rows - 1) / 2, (columns - 1) / 2])[:, None, None]
    radius = np.hypot(x, y) / np.hypot(x, y).max()
    blocks[..., GX_R] = blocks[..., GXX] * radius**2 * x / np.hypot(x, y).max()
    blocks[..., GY_R] = blocks[..., GYY] * radius**2 * y / np.hypot(x, y).max()
    reason = only_reason(with_residuals(explained, blocks=blocks))
    assert reason.what == "frames are deformed as no motion of the whole frame explains"
    shifts = (radius**2 * np.array([x, y]) / np.hypot(x, y).max()).reshape(2, -1).T
    affine = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    left = shifts - affine @ np.linalg.lstsq(affine, shifts)[0]
    assert reason.figure == pytest.approx(np.sqrt((left**2).sum(axis=1).mean()), rel=0.1)


def test_shift_and_zoom_of_the_whole_frame_are_no_deformation(explained: Explained) -> None:
    blocks = explained.residuals.blocks.copy()
    blocks[..., GX_R] = blocks[..., GXX] * (0.5 + 0.05 * np.arange(blocks.shape[1]))
    assert judge(with_residuals(explained, blocks=blocks), ()).status == "trusted"


def test_shifts_that_change_from_row_to_row_are_no_deformation(explained: Explained) -> None:
    """Along a pan, a row of blocks sees the same edges all the time, always at the same fraction of a pixel."""
    blocks = explained.residuals.blocks.copy()
    blocks[..., GY_R] = blocks[..., GYY] * 0.08 * (-1) ** np.arange(blocks.shape[0])[:, None]
    assert judge(with_residuals(explained, blocks=blocks), ()).status == "trusted"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda std_px: std_px + 3, "the expected error of the motion is large"),
        (lambda std_px: np.where(np.arange(len(std_px)) == 70, 9000, std_px), "the expected error of the motion is large"),
        (lambda std_px: std_px + np.inf, "no motion is known"),
    ],
)
def test_uncertain_motion_is_doubtful(explained: Explained, change: Callable[..., Any], what: str) -> None:
    motion = replace(explained.motion, std_px=change(explained.motion.std_px))
    [reason] = judge(replace(explained, motion=motion), ()).reasons
    assert reason.what == what
    if motion.std_px.max() == 9000:
        assert reason.where == "px on average, most at frame 70"


def test_contradicting_pairs_are_doubtful_above_a_tenth() -> None:
    assert contradictions(10, 100) is None
    reason = contradictions(11, 100)
    assert reason is not None
    assert reason.where == "11 of 100 pairs of the last level"


@pytest.mark.parametrize(("n_pairs", "status"), [(2, "trusted"), (3, "doubtful")])
def test_level_is_ambiguous_from_three_pairs_on(explained: Explained, n_pairs: int, status: str) -> None:
    pairs = tuple((index + 1, index) for index in range(n_pairs))
    located = SimpleNamespace(
        ambiguity=Ambiguity(1, pairs, 40.0), edges=(None,) * 30, solution=SimpleNamespace(turns=None, outliers=())
    )
    levels: Any = [SimpleNamespace(level=SimpleNamespace(number=1), located=located)]
    assert judge(explained, levels).status == status


def test_several_reasons_are_listed_together(explained: Explained) -> None:
    gain = explained.residuals.pixel_gain + 7
    found = replace(with_residuals(explained, pixel_gain=gain, misfit=explained.residuals.misfit + 2), ratio=5.0)
    assert [reason.what.split()[0] for reason in judge(found, ()).reasons] == ["the", "the", "single"]


def test_reason_is_a_sentence() -> None:
    reason = Reason("the light changes", 0.1234, 0.03, "most at frame 7", "keep it steady")
    assert str(reason) == "the light changes (most at frame 7): 0.123, trusted up to 0.03; keep it steady"
    assert str(replace(reason, where="")) == "the light changes: 0.123, trusted up to 0.03; keep it steady"
