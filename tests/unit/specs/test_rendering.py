"""The section `render`: the keys that choose a renderer, beside the framework's own."""

import pytest

from photonpano import SpecError, StreamInfo
from photonpano.specs import check_stream, parse_spec

MINIMAL = {"version": 1, "source": {"use": "simulator"}}
SHARP = {"use": "sharp", "with": {"rounds": 9}}


def test_renderer_is_merge_by_default(catalog):
    for written in ({}, {"render": None}, {"render": {"scale": 2.0}}):
        plan = parse_spec(MINIMAL | written, catalog=catalog)
        assert plan.renderer.contribution.name == "merge"
        assert {key: plan.document["render"][key] for key in ("use", "with")} == {"use": "merge", "with": {}}


def test_renderer_stands_beside_the_settings_and_is_read_back_from_the_record(catalog):
    plan = parse_spec(MINIMAL | {"render": SHARP | {"scale": 2.0}}, catalog=catalog)
    assert (plan.renderer.contribution.name, plan.renderer.config.rounds, plan.render.scale) == ("sharp", 9, 2.0)
    again = parse_spec(plan.document, catalog=catalog)
    assert (again.renderer, again.document) == (plan.renderer, plan.document)


@pytest.mark.parametrize(
    ("render", "message"),
    [
        ({"use": "shrap"}, "render.use: there is no renderer 'shrap'; did you mean 'sharp'?"),
        ({"use": 3}, "render.use: expected the name of the renderer, got 3"),
        ({"use": "opencv-sift"}, "render.use: there is no renderer 'opencv-sift'; it is one of the locators"),
        ({"use": "sharp", "with": {"round": 3}}, "render.with.round: unknown key; did you mean 'rounds'?"),
        ({"use": "sharp", "with": {"rounds": 0}}, "render.with.rounds: expected an integer from 1 to 99, got 0"),
        ({"use": "sharp", "rounds": 3}, "render.rounds: unknown key; it belongs under `render.with`"),
        ({"with": {"rounds": 3}}, "render.with.rounds: unknown key; no keys are allowed here"),
        ({"scal": 3}, "render.scal: unknown key; did you mean 'scale'?"),
        ({"extent": [0, 0, 0, 9]}, "render.extent: expected [x0, y0, x1, y1] with x0 < x1 and y0 < y1, got [0, 0, 0, 9]"),
        ({"extent": [0, 0, 9]}, "render.extent: expected panorama, reference or a list of 4 integers, got a list of 3"),
        ({"tone": "drag"}, "render.tone: expected srgb, reinhard, drago, mantiuk or local, got 'drag'"),
        ("sharp", "render: expected a mapping, got 'sharp'"),
    ],
)
def test_wrong_section_is_one_problem(catalog, render, message):
    with pytest.raises(SpecError) as caught:
        parse_spec(MINIMAL | {"render": render}, catalog=catalog)
    assert [str(problem) for problem in caught.value.problems] == [message]


def test_check_of_renderer_is_reported_at_its_section(catalog):
    plan = parse_spec(f"version: 1\nsource: {{use: simulator}}\nrender: {SHARP}", catalog=catalog)
    info = StreamInfo(n_frames=1000, height=8, width=16, frame_rate_hz=None)
    assert [str(each) for each in check_stream(plan, info)] == ["3:1: render: 9 rounds are too many for frames of 8 rows"]
