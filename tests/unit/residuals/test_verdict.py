"""The verdict: each test finds the residuals that were made for it, and nothing else; photon noise is trusted."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from photonpano import FrameSpan
from photonpano.geometry import Camera
from photonpano.motion.graph import Freed, Rival
from photonpano.motion.loop import LevelResult
from photonpano.motion.models import SAME_LENS_PX, MotionModel
from photonpano.residuals import causes
from photonpano.residuals.block_sums import GX_R, GXX, GY_R, GYY, M, R
from photonpano.residuals.findings import NOTHING, Findings, Jump
from photonpano.residuals.halves import Agreements, Halves
from photonpano.residuals.measure import Residuals
from photonpano.residuals.patterns import LensDistortion, Shaking
from photonpano.residuals.refinement import Explained, residual_ratio
from photonpano.residuals.verdict import NARROW, judge, others_px
from photonpano.values import Ambiguity, Edge, Located

SHAPE, N_SPANS, SPAN = (128, 192), 200, 10


Made = dict[str, Any]


def jump(start: int, stop: int) -> Jump:
    return Jump(start, 7.0, 20.0, FrameSpan(start, stop))


def squares(residuals: Residuals, **values: float) -> Made:
    """48 of 300 squares of the panorama with other values."""
    found = {name: getattr(residuals, name).copy() for name in values}
    for name, value in values.items():
        found[name][2:10, 10:16] = value
    return found


def flicker(residuals: Residuals) -> Made:
    gains = np.zeros(len(residuals.spans))
    gains[50:60], gains[55] = 0.2, 0.4
    return {"gradient": residuals.gradient + gains[:, None] * residuals.normal[:, :, 4]}


def dark_corner(residuals: Residuals) -> Made:
    blocks = residuals.blocks.copy()
    blocks[:3, :4, R] -= 0.15 * blocks[:3, :4, M]
    blocks[1, 2, R] -= 0.1 * blocks[1, 2, M]
    return {"blocks": blocks}


def bad_pixels(residuals: Residuals) -> Made:
    gain = residuals.pixel_gain.copy()
    gain[3, :100], gain[100, :100] = 8, 0
    return {"pixel_gain": gain}


def shifted(residuals: Residuals, x_px: Any, y_px: Any = 0.0) -> Made:
    blocks = residuals.blocks.copy()
    blocks[..., GX_R], blocks[..., GY_R] = blocks[..., GXX] * x_px, blocks[..., GYY] * y_px
    return {"blocks": blocks}


def radial(shape: tuple[int, ...]) -> np.ndarray:
    """A lens shifts a block by up to 1 px, outward, with the cube of its distance from the middle: (2, h, w)."""
    y, x = np.mgrid[: shape[0], : shape[1]] - np.array([(side - 1) / 2 for side in shape[:2]])[:, None, None]
    return (x**2 + y**2) * np.array([x, y]) / np.hypot(x, y).max() ** 3


def left_of_radial(shape: tuple[int, ...]) -> float:
    """What a shift, roll, zoom or shear leaves of these shifts."""
    shifts = radial(shape).reshape(2, -1).T
    y, x = np.mgrid[: shape[0], : shape[1]].reshape(2, -1)
    affine = np.stack([np.ones(x.size), x, y], axis=1)
    left = shifts - affine @ np.linalg.lstsq(affine, shifts)[0]
    return float(np.sqrt((left**2).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("change", "what", "figure", "where"),
    [
        pytest.param(
            lambda found: squares(found, cell_chi2=9),
            "parts of the panorama change over time",
            pytest.approx(48 / 300),
            "mostly x 160 to 256, y 32 to 160 in px of the panorama",
            id="changing scene",
        ),
        pytest.param(
            flicker,
            "the light changes over time",
            pytest.approx(np.sqrt((9 * 0.2**2 + 0.4**2) / 200), rel=0.05),
            "most at frames 550 to 559",
            id="light",
        ),
        pytest.param(
            dark_corner,
            "parts of the sensor count more or fewer photons than others",
            pytest.approx(0.06, rel=0.1),
            "most at pixel (40, 24) of the frame",
            id="sensor",
        ),
        pytest.param(
            bad_pixels,
            "single pixels count far more, or far fewer, photons",
            pytest.approx(200 / (128 * 192)),
            "200 pixels",
            id="hot and dead pixels",
        ),
        pytest.param(
            lambda found: shifted(found, *radial(found.blocks.shape)),
            "frames are deformed as no motion of the whole frame explains",
            pytest.approx(left_of_radial((8, 12)), rel=0.1),
            "px, over the frame",
            id="deformation",
        ),
        pytest.param(
            lambda _: {"shaking": Shaking(0.3, 4.2, 1)},
            "frames shake faster than the motion that was found can follow",
            0.3,
            "px within spans, most with a period of 4.2 frames",
            id="shaking",
        ),
    ],
)
def test_what_residuals_show_is_a_note_and_the_cause_of_a_doubt(
    explained: Explained, change: Callable[[Residuals], Made], what: str, figure: Any, where: str
) -> None:
    found = replace(explained, residuals=replace(explained.residuals, **change(explained.residuals)))
    verdict = judge(found, ())
    assert (verdict.status, verdict.reasons) == ("trusted", ())
    [note] = verdict.notes
    assert note.what.startswith(what)
    assert (note.figure, note.where) == (figure, where)
    assert note.figure > note.threshold
    assert note.what_to_do
    doubted = judge(replace(found, motion=replace(found.motion, std_px=found.motion.std_px + 3)), ())
    assert [reason.what for reason in doubted.reasons] == ["the expected error of the motion is large", note.what]
    assert (doubted.status, doubted.notes) == ("doubtful", ())


@pytest.mark.parametrize(
    ("apart_px", "where"),
    [
        (lambda y, _: 0.5 * (y % 2), "0.5 px between odd and even rows"),
        (lambda _, x: 0.5 * (x % 2), "0.5 px between odd and even columns"),
        (lambda y, _: 0.5 * (y >= 64), "0.5 px between rows 0 to 63 and rows 64 to 127"),
        (lambda _, x: 0.5 * (x < 40), "0.5 px between columns 0 to 39 and columns 40 to 191"),
        (lambda y, _: 0.5 * (y % 4 == 3), "0.5 px between one of 4 rows, from 3 on, and the others"),
        (lambda y, x: 0.5 * (y < 64) * (x >= 96), "0.5 px between columns 0 to 95 and columns 96 to 191, in rows 0 to 63"),
        (lambda y, x: 0.5 * (y % 2) * (x >= 96), "0.5 px between odd and even rows, in columns 96 to 191"),
        (lambda y, _: y / 20 - (y / 40) ** 2, ""),  # a rolling shutter
        (lambda y, _: 0.5 * (y >= 64) + (y / 64 - 1) ** 5, "0.5 px between rows 0 to 63 and rows 64 to 127"),  # and a lens
        (lambda y, _: 0.1 * (y % 2), ""),
    ],
)
def test_parts_of_the_sensor_that_lie_apart_are_doubtful(
    explained: Explained, apart_px: Callable[[np.ndarray, np.ndarray], np.ndarray], where: str
) -> None:
    shifts = apart_px(*np.indices((128, 192))) + np.random.default_rng(0).standard_normal((128, 192)) / 10
    ones, zeros = np.ones_like(shifts), np.zeros_like(shifts)
    slopes = 100 * np.stack([ones, shifts, ones, zeros, zeros, zeros]).astype(np.float32)
    verdict = judge(replace(explained, residuals=replace(explained.residuals, pixel_slopes=slopes)), ())
    assert [f"{reason.figure:.1f} {reason.where}" for reason in verdict.reasons] == [where] * bool(where)


def test_parts_are_named_where_noise_would_not_set_any_apart(explained: Explained) -> None:
    """Thousands are compared: by noise, one lies 4 standard deviations apart in a few of a hundred captures, and 6 in none.

    An edge is seen by rows beside each other at the same fraction of a pixel, so that their shifts are alike.
    """
    ones, zeros, rows = np.ones((128, 192)), np.zeros((128, 192)), np.indices((128, 192))[0]

    def named(apart_px: float, seed: int, edges_px: float = 0.0) -> list[str]:
        shifts = apart_px * (rows >= 64) + edges_px * np.sin(rows / 5) + np.random.default_rng(seed).standard_normal(rows.shape)
        slopes = np.stack([ones, shifts, ones, zeros, zeros, zeros]).astype(np.float32)
        residuals = replace(explained.residuals, pixel_slopes=slopes)
        return [reason.where for reason in judge(replace(explained, residuals=residuals), ()).reasons]

    assert [named(0.0, seed) for seed in range(20)] == [[]] * 20
    assert named(0.0, 0, edges_px=0.3) == []
    assert named(0.4, 0) == ["px between rows 0 to 63 and rows 64 to 127"]


def test_expected_error_holds_the_distance_of_parts_that_a_motion_can_follow(explained: Explained) -> None:
    """Rows that take turns see one motion, and the panorama alone is torn; that of a lower half may be that of the frame."""
    ones, zeros, rows = np.ones((128, 192)), np.zeros((128, 192)), np.indices((128, 192))[0]
    for apart_px, beyond_px in ((rows % 2, 0.0), (rows >= 64, 1.0)):
        slopes = 100 * np.stack([ones, apart_px, ones, zeros, zeros, zeros]).astype(np.float32)
        torn = replace(explained, residuals=replace(explained.residuals, pixel_slopes=slopes))
        run = causes.TestedRun(torn, (), NOTHING)
        assert judge(torn, ()).reasons[0].figure == pytest.approx(1)
        assert others_px(run) == pytest.approx(beyond_px)


def test_part_that_is_late_is_named_where_the_motion_returns(explained: Explained) -> None:
    """20 frames, at 0.1 px a frame along x in half of the spans, and back in the others: no shift is left."""
    late = 20.0 * (np.indices((128, 192))[0] >= 64) + np.random.default_rng(0).standard_normal((128, 192))
    ones, zeros = np.ones_like(late), np.zeros_like(late)
    slopes = np.stack([100 * ones, zeros, 100 * ones, zeros, ones, late]).astype(np.float32)
    [reason] = judge(replace(explained, residuals=replace(explained.residuals, pixel_slopes=slopes)), ()).reasons
    assert reason.where == "px between rows 0 to 63 and rows 64 to 127, as if read 20 frames apart"
    assert reason.figure == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize(("filtered", "doubtful"), [(0.2, True), (0.05, False)])
def test_pixels_behind_a_colour_filter_that_is_not_known_are_doubtful(
    explained: Explained, filtered: float, doubtful: bool
) -> None:
    gain = np.ones((128, 192), np.float32)
    gain[1::2, ::2] -= np.float32(filtered)
    verdict = judge(replace(explained, residuals=replace(explained.residuals, pixel_gain=gain)), ())
    said = "of the light, from pixel (0, 0) of each 2x2 to pixel (0, 1)"
    found = [reason for reason in verdict.reasons if reason.what.startswith("pixels that take turns")]
    assert [(reason.figure, reason.where) for reason in found] == [(pytest.approx(filtered), said)] * doubtful


def test_photons_that_the_panorama_does_not_explain_are_doubtful(explained: Explained) -> None:
    """2 variances of 100 photons beyond the noise are sqrt(200) of 100 photons."""
    residuals = replace(explained.residuals, reduced_chi2=explained.residuals.reduced_chi2 + 2)
    [reason] = judge(replace(explained, residuals=residuals), ()).reasons
    assert reason.what.startswith("the panorama does not explain the photons")
    assert (reason.figure, reason.where) == (pytest.approx(3, abs=0.05), "on average by 14% of the light")


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda _: {}, id="photon noise"),
        # In the dark, noise draws the whole panorama down, and no span differs from the others.
        pytest.param(
            lambda found: {"gradient": found.gradient + 0.1 * found.normal[:, :, 4]},
            id="more photons than predicted all the time",
        ),
        # With 10,000 times the photons, a reduced chi-square of 1.5 is 0.07 % of the light.
        pytest.param(
            lambda found: {"reduced_chi2": found.reduced_chi2 + 0.5, "blocks": 1e4 * found.blocks},
            id="reduced chi-square of little light",
        ),
        # A reduced_chi2 of 9 where the noise is 1 % of the light is a change by 3 %.
        pytest.param(lambda found: squares(found, cell_chi2=9, cell_noise=1e-4), id="place that hardly changes"),
        pytest.param(lambda found: squares(found, cell_chi2=9, cell_count=3), id="place that few blocks saw"),
        pytest.param(lambda found: shifted(found, 0.5 + 0.05 * np.arange(found.blocks.shape[1])), id="shift and zoom"),
        # Along a pan, a row of blocks sees the same edges all the time, always at the same fraction of a pixel.
        pytest.param(lambda found: shifted(found, 0, 0.08 * (-1) ** np.arange(8)[:, None]), id="shifts row by row"),
    ],
)
def test_residuals_like_noise_are_trusted(explained: Explained, change: Callable[[Residuals], Made]) -> None:
    verdict = judge(replace(explained, residuals=replace(explained.residuals, **change(explained.residuals))), ())
    assert (verdict.status, verdict.reasons, verdict.notes, verdict.residual_ratio) == ("trusted", (), (), 1.05)


@pytest.mark.parametrize(("n_spans", "doubtful"), [(20, True), (60, False)])
def test_motion_of_a_capture_that_is_too_short_for_any_test_is_doubtful(
    explained: Explained, n_spans: int, doubtful: bool
) -> None:
    spans = tuple(FrameSpan(frame, frame + 1) for frame in range(n_spans))
    few = {"instants": np.arange(n_spans), "light": np.ones(n_spans), "shaking": Shaking(0.0, float("nan"), 1)}
    of_spans = {name: getattr(explained.residuals, name)[:n_spans] for name in ("normal", "gradient", "reduced_chi2")}
    residuals = replace(explained.residuals, spans=spans, **few, **of_spans)
    verdict = judge(replace(explained, residuals=residuals, ratio=residual_ratio(residuals)), ())
    assert [(each.figure, each.threshold) for each in verdict.reasons] == [(30, 0)] * doubtful
    assert [each.partition(" than")[0] for each in verdict.untested] == [
        "whether the image moves within groups by more",
        "whether frames shake faster",
    ] * doubtful


@pytest.mark.parametrize(
    ("change", "what", "where"),
    [
        (lambda std_px: std_px + 3, "the expected error of the motion is large", "px on average, most at frame 0"),
        (
            lambda std_px: np.where(np.arange(len(std_px)) == 70, 9000, std_px),
            "the expected error of the motion is large",
            "px on average, most at frame 70",
        ),
        (lambda std_px: std_px + np.inf, "no motion is known", "a single exposure was located"),
    ],
)
def test_uncertain_motion_is_doubtful(explained: Explained, change: Callable[..., Any], what: str, where: str) -> None:
    motion = replace(explained.motion, std_px=change(explained.motion.std_px))
    [reason] = judge(replace(explained, motion=motion), ()).reasons
    assert (reason.what, reason.where) == (what, where)
    assert np.isfinite(reason.figure)


UNINFORMED = Located(np.eye(3))


def level_with(
    rotations: object | None = None,
    rivals: Mapping[str, Rival] | None = None,
    n_ambiguous: int = 0,
    motion: Located = UNINFORMED,
    change_px: float | None = None,
    drift_share: float = 0.0,
    **of_solution: object,
) -> Any:
    """A level of 30 pairs."""
    pairs = tuple((index + 1, index) for index in range(n_ambiguous))
    ambiguity = Ambiguity(1, pairs, 40.0) if pairs else None
    known = {
        "rotations": rotations,
        "walks_px": {"zoom": 1.0},
        "outliers": (),
        "model": MotionModel(kind="rotation"),
        "freed": lambda: None,
        "parallax": 0.0,
    }
    solution = SimpleNamespace(**known | of_solution)
    edges = (Edge(1, 0, motion),) * 30
    located = SimpleNamespace(
        ambiguity=ambiguity,
        rivals=rivals or {},
        edges=edges,
        solution=solution,
        frame_shape=SHAPE,
        std_px=np.full(31, 4.0),
        drift_share=drift_share,
    )
    level = SimpleNamespace(
        level=SimpleNamespace(number=1), located=located, change_px=change_px, uncertainty=SimpleNamespace(mean_px=1.0)
    )
    level.narrow = LevelResult.narrow.fget(level)
    return level


@pytest.mark.parametrize(("drift_share", "doubtful"), [(0.0, True), (0.96, False)])
def test_bend_of_a_long_path_is_trusted(explained: Explained, drift_share: float, doubtful: bool) -> None:
    motion = replace(explained.motion, std_px=np.where(explained.motion.located, 4.0, np.inf))
    verdict = judge(replace(explained, motion=motion), [level_with(drift_share=drift_share)])
    assert [reason.figure for reason in verdict.reasons] == [pytest.approx(4)] * doubtful


@pytest.mark.parametrize(("times", "deviance", "doubtful"), [(9.0, 0.0, False), (2.0, 40.0, False), (9.0, 40.0, True)], ids=str)
def test_model_that_holds_less_than_the_motion_is_doubtful(
    explained: Explained, times: float, deviance: float, doubtful: bool
) -> None:
    """Homographies are likelier, and farther away than the motion is expected to err."""
    rivals = {"homography": Rival(1.0, 232, 0.0, times * float(np.hypot(1, SAME_LENS_PX))), "affine": Rival(1.0, 88, deviance)}
    reasons = judge(explained, [level_with(None, rivals, model=MotionModel(kind="affine"))]).reasons
    assert [(reason.what, pytest.approx(reason.figure)) for reason in reasons] == [(NARROW, times)] * doubtful
    assert all("affine" in reason.where for reason in reasons)
    # More light would not help: the distance to homographies is in the expected error.
    unsure = replace(explained, motion=replace(explained.motion, std_px=explained.motion.std_px + 3))
    [reason] = judge(unsure, [level_with(None, rivals, model=MotionModel(kind="affine"))]).reasons
    assert (reason.what == NARROW) == doubtful


FIND = "camera: {distortion: {k1: find}}"
TO_ROTATIONS = f"write motion: {{model: rotation}} and {FIND} for a camera that only turns"


@pytest.mark.parametrize(
    ("camera", "rivals", "lens"),
    [
        (None, ("homography",), TO_ROTATIONS),
        (None, ("homography", "rotation"), "undistort the frames before"),
        (Camera.of(200, SHAPE), ("rotation",), f"write {FIND}"),
        (Camera.of(200, SHAPE, [-0.1, 0, 0, 0]), ("rotation",), "calibrate the lens, and write camera.distortion"),
    ],
    ids=["homographies", "homographies, likelier than rotations", "rotations", "rotations through a lens that was found"],
)
def test_advice_is_not_what_the_run_does_already(
    explained: Explained, camera: Camera | None, rivals: tuple[str, ...], lens: str
) -> None:
    bent = LensDistortion(-0.1, 0.005, np.zeros((1, 2)))
    run = replace(explained, motion=replace(explained.motion, camera=camera), lens=bent)
    compared = {name: Rival(1.0, 232, 0.0) for name in rivals}
    [reason] = judge(run, [level_with(None, compared, model=MotionModel(kind="homography"))]).reasons
    assert (reason.what, reason.what_to_do) == ("the lens distorts the frames, which bends the motion", lens)


@pytest.mark.parametrize(("turn", "how"), [(np.flipud, "upside down"), (np.fliplr, "left to right"), (None, "")])
def test_hot_pixels_that_lie_where_a_turned_mask_would_be_say_so(
    explained: Explained, turn: Callable[[np.ndarray], np.ndarray] | None, how: str
) -> None:
    masked, hot = (np.random.default_rng(seed).random(explained.residuals.frame_shape) < 0.02 for seed in (3, 4))
    hot = hot if turn is None else turn(masked)
    mean, gain = np.where(masked, 0, 1000).astype(np.float32), np.where(hot, 5, 1).astype(np.float32)
    verdict = judge(replace(explained, residuals=replace(explained.residuals, pixel_mean=mean, pixel_gain=gain)), ())
    said = next(reason for reason in (*verdict.reasons, *verdict.notes) if "single pixels" in reason.what)
    assert said.what_to_do == (f"turn the mask {how}" if how else "mask them (corrections: hot-pixels)")


@pytest.mark.parametrize(("lacks", "doubtful"), [(2.5, False), (3.5, True)])
def test_halves_that_do_not_agree_for_half_of_the_time_are_doubtful(explained: Explained, lacks: float, doubtful: bool) -> None:
    """One cut is far off, as where something passes; the median counts. Cuts that show too little say nothing."""
    stds = np.array([0.01, 0.004, 0.01, np.nan])
    coherence = 1 - np.hypot(stds, 0.001) * [lacks, 20.0, 0.0, np.nan]
    cuts = Agreements(np.array([500.0, 1000.0, 1500.0, 1900.0]), coherence, stds, np.full((4, 2), 0.1), np.zeros(4))
    verdict = judge(replace(explained, halves=Halves(cuts, cuts)), ())
    assert [reason.figure for reason in verdict.reasons] == [pytest.approx(lacks)] * doubtful
    assert all(reason.where.endswith(", before frame 1000") for reason in verdict.reasons)


@pytest.mark.parametrize(
    ("freed", "says"),
    [
        (None, None),
        (Freed(0, 330.0, 331.8, 0.2), None),
        (Freed(0, 500.0, 431.21, 2.0), "a focal length of 431.2 ± 2 px fits, 500 px is given; in expected errors"),
        (Freed(1, -0.1, -0.0481, 0.004), "k1 of -0.0481 ± 0.004 fits, -0.1 is given; in expected errors"),
    ],
)
def test_camera_that_pairs_contradict_by_ten_expected_errors_is_doubtful(
    explained: Explained, freed: Freed | None, says: str | None
) -> None:
    reasons = judge(explained, [level_with(freed=lambda: freed)]).reasons
    assert [reason.where for reason in reasons] == ([] if says is None else [says])


@pytest.mark.parametrize(
    ("findings", "figure", "where"),
    [
        (Findings(standing_share=0.6), 0.6, "share of the parts that show motion or rest"),
        (Findings(cuts=(jump(3, 6), jump(9, 13))), 2, "frames 3 to 5, frames 9 to 12"),
    ],
)
def test_findings_are_doubtful(explained: Explained, findings: Findings, figure: float, where: str) -> None:
    [reason] = judge(explained, (), findings).reasons
    assert (reason.figure, reason.where) == (figure, where)
    assert not judge(explained, (), Findings(standing_share=0.4)).reasons


def test_background_that_is_mostly_hidden_is_doubtful(explained: Explained) -> None:
    """A thing that fills the middle of all frames passes for the scene, and what is seen beside it for what hides that."""
    found = [judge(explained, (), Findings(hidden_share=share)).reasons for share in (0.48, 0.52)]
    assert [[reason.figure for reason in reasons] for reasons in found] == [[], [0.52]]


def test_camera_that_travels_past_near_things_is_named_first(explained: Explained) -> None:
    """Not the lens that this bends, nor more light for the expected error, which holds the way of what is near."""
    motion = replace(explained.motion, std_px=explained.motion.std_px + 3)
    bent = replace(explained, motion=motion, lens=LensDistortion(-0.1, 0.005, np.zeros((1, 2))))
    levels = [level_with(object(), parallax=0.04), level_with(object())]
    whats = [reason.what for reason in judge(bent, levels, Findings(hidden_share=0.52)).reasons]
    assert whats == [
        "the camera travels by about 0.04 of the distance of what is near, and much of the frames shows that",
        "the lens distorts the frames, which bends the motion",
    ]


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
