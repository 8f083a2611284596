"""What a component does wrong although it keeps its contract is found by one check of the kit each.

What the check says of each is a regular expression in behaviours.txt.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from photonpano import testing
from photonpano.testing.conformance import Conformance
from photonpano.testing.stages import AnswerConformance

from . import images, motions
from .conftest import known_path

GOLDEN = dict(line.split(" -> ") for line in Path(__file__).with_name("behaviours.txt").read_text().splitlines())
GOOD = {
    testing.ResamplerConformance: (motions.Hundreds, motions.RESAMPLERS),
    testing.MergerConformance: (images.merger, images.MERGERS),
    testing.LocatorConformance: (motions.locator, motions.LOCATORS),
    testing.InterpolatorConformance: (motions.Straight, motions.INTERPOLATORS),
    testing.RefinerConformance: (motions.Steps, motions.REFINERS),
    testing.RendererConformance: (images.renderer, images.RENDERERS),
    testing.PoseEstimatorConformance: (motions.turning_refused(known_path), motions.pose_estimators(known_path)),
}
BROKEN = {f"{kit.kind}, {name}": (kit, build) for kit, (_, builds) in GOOD.items() for name, build in builds.items()}


def check_of(name: str) -> str:
    return f"test_{name.partition(',')[0]}"


@pytest.mark.parametrize("name", BROKEN)
def test_check_fails_on_broken_component(name: str, catches: Callable[..., None]) -> None:
    kit, broken = BROKEN[name]
    catches(kit, check_of(name.partition(", ")[2]), broken, GOLDEN[name])


@pytest.mark.parametrize("kit", GOOD)
def test_good_component_passes_and_every_check_has_a_broken_one(
    kit: Any, checks_of: Callable[..., set[str]], failure: Callable[..., str | None]
) -> None:
    good, broken = GOOD[kit]
    record = {"check": lambda _, stream: ["too short"] if stream.n_frames < 100 else []} if kit.kind == "resampler" else {}
    for check in checks_of(kit, Conformance):
        assert failure(kit, check, good, record=record) is None, check
    assert checks_of(kit, AnswerConformance) == set(map(check_of, broken))


INFORMATION = "test_information_is_inverse_covariance_of_errors"
PLACES = "test_different_places_are_not_located"
DARK = "test_dark_counts_are_subtracted_or_source_is_refused"


@pytest.mark.parametrize(
    ("kit", "check", "build", "attributes"),
    [
        (testing.MergerConformance, DARK, images.merges_given(images.refusing_dark_counts), {}),
        (testing.RendererConformance, DARK, images.renders_given(images.refusing_dark_counts), {}),
        (
            testing.LocatorConformance,
            "test_homography_maps_moving_to_fixed",
            motions.registers(motions.needing_a_start),
            {"needs_start": True},
        ),
        (
            testing.LocatorConformance,
            "test_register_finds_motion_without_start",
            motions.locates(motions.shift_alone),
            {"motions": ("shift",), "tolerance_px": 1.0},
        ),
        (
            testing.LocatorConformance,
            INFORMATION,
            motions.locates(motions.six_left_alone),
            {"motions": ("shift",), "free": (4, 5)},
        ),
        (
            testing.LocatorConformance,
            PLACES,
            motions.locator,
            {"motions": (), "shape": (48, 64)},
        ),
        (testing.RefinerConformance, "test_answers_keep_the_contract", motions.refines(lambda *_: None), {}),
    ],
)
def test_attributes_of_a_class_suit_other_components(
    failure: Callable[..., str | None], kit: type, check: str, build: Any, attributes: dict[str, Any]
) -> None:
    assert failure(kit, check, build, **attributes) is None


@pytest.mark.parametrize(
    ("check", "build", "attributes", "words"),
    [
        (INFORMATION, motions.locates(motions.six_left_alone), {"motions": ("shift",)}, "and it predicts"),
        (INFORMATION, motions.BOASTING, {"motions": ("shift",), "free": (4, 5)}, "and it predicts"),
        (
            PLACES,
            motions.registers(motions.STANDING_STILL),
            {"motions": (), "shape": (48, 64)},
            "must not be located",
        ),
    ],
)
def test_attributes_of_a_class_hide_no_defect(
    catches: Callable[..., None], check: str, build: Any, attributes: dict[str, Any], words: str
) -> None:
    catches(testing.LocatorConformance, check, build, words, **attributes)


@pytest.mark.parametrize(
    ("kit", "check", "build", "attributes", "reason"),
    [
        (
            testing.MergerConformance,
            "test_merge_compensates_known_motion",
            images.merges_given(lambda source, group, _, scale: (source, group, None, scale)),
            {"compensates": False},
            "compensates = False",
        ),
        (
            testing.LocatorConformance,
            "test_homography_maps_moving_to_fixed",
            motions.locates(motions.inverted),
            {"motions": ()},
            "motions",
        ),
    ],
)
def test_checks_that_do_not_apply_are_skipped(
    failure: Callable[..., str | None], kit: type, check: str, build: Any, attributes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(pytest.skip.Exception, match=reason):
        failure(kit, check, build, **attributes)
