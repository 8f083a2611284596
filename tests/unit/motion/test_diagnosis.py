from textwrap import dedent
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan, Group, Located, LocationError, NotLocated, VirtualExposure
from photonpano.motion.diagnosis import Contrast, contrast_of, require_in_front, require_tied
from photonpano.motion.graph import GraphSolution
from photonpano.photometry import BinaryResponse
from photonpano.values import Edge


@given(st.integers(1, 100_000))
def test_contrast_is_blank_if_all_pixels_are_saturated_and_not_if_one_has_one_dark_frame(frames: int) -> None:
    response, weight = BinaryResponse(), np.full((4, 6), frames, np.float32)
    counts = np.full((4, 6), frames)
    for saturated in (True, False):
        counts[1, 2] -= not saturated
        flux = response.flux((counts / frames).astype(np.float32), weight)
        blank = contrast_of(VirtualExposure(flux, weight, GROUPS[0], 1.0, response)).blank
        sentence = "every pixel is saturated, so that its flux is unknown; use a smaller aperture"
        assert blank == (sentence if saturated else None)


N = 10
GROUPS = tuple(Group(FrameSpan(100 * index, 100 * index + 100), 100 * index + 49.5) for index in range(N))
CLEAR = Contrast(12.34)


def require(
    lost: tuple[int, ...],
    contrast: Contrast = CLEAR,
    disconnected: Literal["error", "largest"] = "error",
    reason: str = "3 matches, fewer than min_inliers = 12 (80 and 91 keypoints)",
    foreseen: int = N,
) -> None:
    """Check a chain of ten exposures, the first `foreseen`; every pair of a lost one failed."""
    found, failed = Located(np.eye(3)), NotLocated(reason)
    edges = [Edge(later, later - 1, failed if {later, later - 1} & set(lost) else found) for later in range(1, N)]
    tied = np.array([0 if index not in lost else 1 + index for index in range(N)])
    contrasts = {index: contrast if index in lost else CLEAR for index in range(N)}
    require_tied(2, GROUPS, edges, parts=tied, contrasts=contrasts, disconnected=disconnected, foreseen=np.arange(N) < foreseen)


@pytest.mark.parametrize(
    ("lost", "disconnected"),
    [
        *((lost, "error") for lost in ((), (0,), (4,), (4, 5), (0, 3, 6, 9), (8, 9))),
        *((lost, "largest") for lost in ((4, 5, 6), (0, 1, 2, 3, 4, 5, 6, 7))),
    ],
)
def test_require_tied_accepts_two_lost_exposures_in_a_row_or_the_largest_part(
    lost: tuple[int, ...], disconnected: Literal["error", "largest"]
) -> None:
    require(lost, disconnected=disconnected)
    require_tied(1, GROUPS[:1], [], parts=np.array([0]), contrasts={0: CLEAR}, disconnected="error")


def refusal(*args: Any, **kwargs: Any) -> str:
    with pytest.raises(LocationError) as caught:
        require(*args, **kwargs)
    return str(caught.value)


def test_refusal_names_lost_frames_and_failed_pairs() -> None:
    assert (
        refusal((4, 5, 6))
        == dedent(
            """
        level 2: 4 of 9 pairs of exposures could not be located, so that frames 400 to 699 cannot be tied to the rest
        Parts that are tied together: frames 0 to 399 with frames 700 to 999.
          frames 400 to 499 onto frames 300 to 399: 3 matches, fewer than min_inliers = 12 (80 and 91 keypoints)
          frames 500 to 599 onto frames 400 to 499: 3 matches, fewer than min_inliers = 12 (80 and 91 keypoints)
          frames 600 to 699 onto frames 500 to 599: 3 matches, fewer than min_inliers = 12 (80 and 91 keypoints)
          frames 700 to 799 onto frames 600 to 699: 3 matches, fewer than min_inliers = 12 (80 and 91 keypoints)
        In these exposures of 100 frames the scene varies 12 times as much as a pixel's photon noise, so darkness is \
not the cause: either motion blurs them (try smaller groups, such as resample.with.group_size=50), or the scene has no \
texture there.
        To go on with the largest part alone, set graph.disconnected to largest.
        """
        ).strip()
    )


@pytest.mark.parametrize(
    ("contrast", "advice"),
    [
        (
            Contrast(0.17),
            "varies 0.17 times as much as a pixel's photon noise: either they are too dark (try larger groups, such as "
            "resample.with.group_size=200), or the scene has no texture there.",
        ),
        (
            Contrast(0.0),
            "does not stand out from a pixel's photon noise: either they are too dark (try larger groups, such as "
            "resample.with.group_size=200), or the scene has no texture there.",
        ),
        (
            Contrast(0.8),
            "varies 0.8 times as much as a pixel's photon noise: either motion blurs them (try smaller groups, such as "
            "resample.with.group_size=50), or they are too dark for what texture there is (try larger ones, such as "
            "resample.with.group_size=200).",
        ),
    ],
)
def test_refusal_advises_by_the_signal_to_noise_ratio(contrast: Contrast, advice: str) -> None:
    lines = refusal((0, 1, 2, 7, 8, 9), contrast).splitlines()
    assert lines[0] == (
        "level 2: 6 of 9 pairs of exposures could not be located, "
        "so that frames 0 to 299 and frames 700 to 999 cannot be tied to the rest"
    )
    assert lines[-2:] == [
        f"In these exposures of 100 frames the scene {advice}",
        "To go on with the largest part alone, set graph.disconnected to largest.",
    ]


def test_exposures_beyond_the_horizon_are_named() -> None:
    groups = [Group(FrameSpan(10 * index, 10 * index + 10), 10 * index) for index in range(6)]
    homographies = np.array([np.eye(3)] * 6)
    homographies[3:5, 2, 0] = -0.1
    homographies[0] = np.nan
    solution = GraphSolution(
        homographies=homographies,
        located=np.arange(6) > 0,
        outliers=(),
        residual_px=0.0,
        assess=lambda: (np.empty(0), np.empty(0)),
    )
    with pytest.raises(LocationError) as caught:
        require_in_front(2, groups, solution, (40, 60), ValueError("no root"))
    assert str(caught.value) == (
        "level 2: frames 30 to 49 reach the horizon of the plane that all exposures are located in: pairs are wrong (try other "
        "groups or another locator), or the camera turns too far for one plane (write motion: {model: rotation})"
    )
    homographies[3:5] = np.eye(3)
    require_in_front(2, groups, solution, (40, 60), ValueError("no root"))
