from __future__ import annotations

from typing import Any

import pytest

from photonpano.pipeline.components import build_source
from photonpano.pipeline.forecast import TRIAL_GROUPS, forecast
from photonpano.specs import parse_spec


def test_forecast_predicts_time_memory_and_canvas(small_spec: dict[str, Any]) -> None:
    plan = parse_spec(small_spec | {"resample": {"with": {"group_size": 20}}, "levels": 2})
    with build_source(plan) as source:
        found = forecast(plan, source)
        n_frames = source.info.n_frames
    assert len(found.tried) == 20 * TRIAL_GROUPS < n_frames
    assert abs(found.tried.centre - (n_frames - 1) / 2) <= 1
    assert set(found.seconds) == {"level 1", "level 2", "panorama"}
    assert min(found.seconds.values()) > 0
    assert found.memory_bytes > 30 * 2**20
    # The camera pans by 60 px over the capture, and trembles.
    assert 190 < found.canvas[1] < 290
    assert 128 <= found.canvas[0] < 220


@pytest.mark.parametrize(("extent", "shape"), [("reference", (256, 320)), ([-10, 5, 20, 25], (40, 60))])
def test_forecast_of_a_part_has_the_size_of_the_part(small_spec: dict[str, Any], extent: Any, shape: tuple[int, int]) -> None:
    render = {"extent": extent, "scale": 2}
    plan = parse_spec(small_spec | {"resample": {"with": {"group_size": 10}}, "levels": 1, "render": render})
    with build_source(plan) as source:
        assert forecast(plan, source).canvas == shape


def test_forecast_of_a_turn_knows_that_a_sphere_ends() -> None:
    """The trial turns by 90 degrees of 500; all around are 377 px, and a box of degrees is left out of account."""
    scene = {"kind": "street", "width": 400, "height": 200}
    turn = {"scene": scene, "path": {"kind": "turn", "degrees": 500}, "frame_shape": [48, 80], "focal_length_px": 60}
    spec = {
        "version": 1,
        "source": {"use": "simulator", "with": turn | {"n_frames": 1000, "flux": 2.0}},
        "motion": {"model": "rotation"},
        "camera": {"focal_px": 60},
        "resample": {"with": {"group_size": 15}},
        "levels": 1,
        "render": {"projection": "spherical", "extent": [0, -10, 20, 10]},
    }
    plan = parse_spec(spec)
    with build_source(plan) as source:
        height, width = forecast(plan, source).canvas
    assert width == 377
    assert 40 <= height < 60
