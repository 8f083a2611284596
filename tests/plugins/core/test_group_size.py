from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import CaptureSummary, CaptureUnreadError, StageContext, StreamInfo
from photonpano_core.configs import MidpointConfig
from photonpano_core.hooks import photonpano_resamplers
from photonpano_core.resamplers import MidpointResampler, choose_group_size, whole_periods

HOW = "the second fastest of 12 places, from sums of 64 frames"


def choice(flux: float, speed_px: float | None, n_frames: int = 10_000, how: str = HOW, shortest: int = 16) -> tuple[int, str]:
    return choose_group_size(CaptureSummary(flux, speed_px, how), n_frames, 254, shortest)


def built(stream: StreamInfo, name: str = "midpoint", **context: Any) -> Any:
    (contribution,) = (each for each in photonpano_resamplers() if each.name == name)
    return contribution.build(contribution.config(group_size="auto"), StageContext(stream, response=None, **context))


SPEED = f"px per frame ({HOW}) groups of"
SIDE = "of the shorter side of a frame, and at a flux of"
NO_SPEED = "no motion was found at any of 12 places"


@pytest.mark.parametrize(
    ("capture", "size", "reason"),
    [
        ((0.5, 0.15), 254, f"at 0.15 {SPEED} 254 frames are blurred by 38.1 px, 0.15 {SIDE} 0.5 hold 127 photons per pixel"),
        ((0.02, 0.3), 150, "hold 3 photons per pixel, so few that more blur is allowed"),
        ((0.001, 0.3), 254, "so few that more blur is allowed"),
        ((0.5, 0.0), 1250, "; of longer groups there would be fewer than 8"),
        ((0.5, 0.001), 1250, "; of longer groups there would be fewer than 8"),
        (
            (0.5, 10.0),
            16,
            f"{SPEED} 16 frames are blurred by 160 px, 0.63 {SIDE} 0.5 hold 8 photons per pixel; shorter groups would be "
            "mostly noise",
        ),
        (
            (2000, 0.5, 10_000, HOW, 1),
            20,
            "hold 4e+04 photons per pixel, enough to shorten groups for less blur",
        ),  # 0.04 of 254
        ((25, 0.5, 10_000, HOW, 1), 40, ", enough to shorten groups for less blur"),  # 1000 photons
        ((0.5, 0.05), 762, "photons per pixel"),  # which are too few
        ((0.01, None, 10_000, NO_SPEED), 500, f"{NO_SPEED}, so 500 frames are assumed"),
        ((0.01, None, 2000, NO_SPEED), 250, "so 500 frames are assumed; of longer groups there would be fewer than 8"),
        # At 500 frames per second the image may move by tens of px per frame.
        ((20, 10.0, 10_000, HOW, 1), 4, "photons per pixel"),
        (
            (2000, 100.0, 10_000, HOW, 1),
            1,
            f"at 1e+02 {SPEED} 1 frame are blurred by 100 px, 0.39 {SIDE} 2e+03 hold 2e+03 photons per pixel",
        ),
    ],
)
def test_group_size_weighs_light_against_motion_blur(capture: tuple[Any, ...], size: int, reason: str) -> None:
    found, why = choice(*capture)
    assert found == size
    assert why.endswith(reason), why


def test_auto_resampler_allows_single_grey_frames() -> None:
    resampler = built(StreamInfo(80, 254, 496, None, "intensity", 8), capture=lambda: CaptureSummary(2000, 38.0, HOW))
    assert {len(group.span) for group in resampler.groups(80, 1)} == {1}


@given(
    flux=st.floats(0, 10),
    speed_px=st.none() | st.floats(0, 100),
    n_frames=st.integers(16, 100_000),
    side=st.integers(8, 1024),
)
def test_choose_group_size_keeps_bounds_for_any_capture(flux: float, speed_px: float | None, n_frames: int, side: int) -> None:
    size, reason = choose_group_size(CaptureSummary(flux, speed_px, HOW), n_frames, side, 16)
    assert 16 <= size <= max(16, n_frames // 8)
    assert "\n" not in reason
    if speed_px and size > 16:
        assert (size - 1) * speed_px <= 0.3 * side


def test_auto_resampler_chooses_and_records_size_once() -> None:
    measured, decided = [], []

    def capture() -> CaptureSummary:
        measured.append(1)
        return CaptureSummary(0.5, 0.381, HOW)

    resampler = built(StreamInfo(1000, 254, 496, None), capture=capture, decide=lambda *what: decided.append(what))
    assert not measured
    fixed = MidpointResampler(MidpointConfig(group_size=100))
    assert [resampler.groups(1000, level) for level in (1, 2, 3)] == [fixed.groups(1000, level) for level in (1, 2, 3)]
    assert measured == [1]
    assert [what[:2] for what in decided] == [("group_size", 100)]


def test_auto_resampler_doubles_groups_of_dim_capture_from_level_3() -> None:
    decided: list[tuple] = []
    resampler = built(
        StreamInfo(2000, 254, 496, None),
        capture=lambda: CaptureSummary(0.05, 0.381, HOW),
        decide=lambda *what: decided.append(what),
    )
    short, long = (MidpointResampler(MidpointConfig(group_size=size)) for size in (100, 200))
    assert [resampler.groups(2000, level) for level in (1, 2)] == [short.groups(2000, level) for level in (1, 2)]
    # As dense as the short ones would be.
    assert resampler.groups(2000, 3) == long.groups(2000, 4)
    assert decided[0][:2] == ("group_size", 100)
    assert decided[0][2].endswith("; from level 3 on, where the motion is known, groups are twice as long for more light")


@pytest.mark.parametrize("name", ["constant-groups", "sliding-window"])
def test_auto_resampler_never_doubles_groups_that_get_no_denser(name: str) -> None:
    """Their number, or their positions, would differ from those of the levels before."""
    resampler = built(StreamInfo(2000, 254, 496, None), name, capture=lambda: CaptureSummary(0.05, 0.381, HOW))
    assert resampler.groups(2000, 3) == resampler.groups(2000, 1)
    assert {len(group.span) for group in resampler.groups(2000, 3)} == {100}


def test_auto_resampler_raises_where_no_frames_are_read() -> None:
    resampler = built(StreamInfo(1000, 254, 496, None))
    with pytest.raises(CaptureUnreadError, match=r"^chosen from flux and speed when the capture is read$"):
        resampler.groups(1000, 1)


def test_check_refuses_capture_shorter_than_shortest_group() -> None:
    for contribution in photonpano_resamplers():
        config = contribution.config(group_size="auto")
        assert contribution.check(config, StreamInfo(16, 8, 8, None)) == []
        assert contribution.check(config, StreamInfo(15, 8, 8, None)) == [
            "the capture has 15 frames, fewer than one group of 16; set group_size to 3 or less, so that at least four groups "
            "fit"
        ]


@pytest.mark.parametrize(
    ("size", "period", "n_frames", "expected"),
    [
        (150, None, 3000, 150),
        (150, 200.0, 3000, 200),
        (210, 200.0, 3000, 200),
        (250, 200.0, 4000, 400),
        (50, 33.4, 3000, 67),
        (150, 200.0, 1500, 150),
        (3, 50.0, 3000, 3),
        (30, 50.0, 3000, 50),
    ],
)
def test_groups_are_lengthened_to_whole_periods(size: int, period: float | None, n_frames: int, expected: int) -> None:
    assert whole_periods(size, period, n_frames) == expected
