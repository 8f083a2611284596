"""The checks of components, of their configs and of a capture."""

import pytest
from pydantic import Field

from photonpano import Config, LocatorContribution, ResamplerContribution, SourceContribution, SpecError, StreamInfo
from photonpano.registry import Catalog
from photonpano.specs import check_stream, load_spec, parse_spec

SHORT = StreamInfo(n_frames=100, height=8, width=16, frame_rate_hz=None)
TOO_LARGE = "a group of {} frames does not fit into the capture, which has 100"


def test_check_stream_of_suitable_capture_finds_nothing(catalog):
    plan = parse_spec("version: 1\nsource: {use: simulator}\nresample: {with: {group_size: 100}}", catalog=catalog)
    assert check_stream(plan, SHORT) == []


def test_check_stream_reports_shared_problem_once_and_override_at_its_level(catalog, tmp_path):
    path = tmp_path / "scan.yaml"
    path.write_text(
        "version: 1\nsource: {use: simulator}\nresample: {with: {group_size: 200}}\nrender: {reference: 100}\n"
        "levels:\n  - {}\n  - {scale: 0.5}\n  - {resample: {with: {group_size: 300}}}\n  - {resample: {with: {stride: 2}}}\n"
    )
    problems = check_stream(load_spec(path, catalog=catalog), SHORT)
    assert [str(problem) for problem in problems] == [
        f"{path}:3:1: resample: {TOO_LARGE.format(200)}",
        f"{path}:8:6: levels.2.resample: {TOO_LARGE.format(300)}",
        f"{path}:4:10: render.reference: expected a frame of the capture, 0 to 99, got 100",
    ]


def test_check_stream_reports_levels_until_converged_once(catalog):
    spec = "version: 1\nsource: {use: simulator}\nresample: {with: {group_size: 200}}\nlevels: until-converged"
    assert [str(problem) for problem in check_stream(parse_spec(spec, catalog=catalog), SHORT)] == [
        f"3:1: resample: {TOO_LARGE.format(200)}"
    ]


def test_check_stream_reports_refiners_where_they_are_written(catalog):
    spec = "version: 1\nsource: {use: simulator}\nresample: {with: {group_size: 50}}\n"
    long = "{use: short-spans, with: {span_frames: 60}}"
    for written, place in ((f"[drift, {long}]", "4:17: refine.1"), (long, "4:1: refine")):
        plan = parse_spec(f"{spec}refine: {written}\n", catalog=catalog)
        assert [str(each) for each in check_stream(plan, SHORT)] == [f"{place}: a capture of 100 frames has no two spans"]


def test_check_stream_reports_fallbacks_where_they_are_written(catalog):
    class Sized(Config):
        at_least: int = Field(description="frames")

    def too_short(config, info):
        return [f"the capture has fewer than {config.at_least} frames"] if info.n_frames < config.at_least else []

    sized = LocatorContribution(name="sized", summary="Toy", config=Sized, build=fail, check=too_short)
    spec = (
        "version: 1\nsource: {use: simulator}\nresample: {with: {group_size: 50}}\n"
        "locate: {fallback: {use: sized, with: {at_least: 101}}}\n"
        "levels:\n  - {locate: {with: {max_steps: 5}}}\n"
        "  - {locate: {fallback: [opencv-sift, {use: sized, with: {at_least: 102}}]}}\n"
    )
    plan = parse_spec(spec, catalog=Catalog(catalog.rows).including(sized))
    assert [str(problem) for problem in check_stream(plan, SHORT)] == [
        "4:10: locate.fallback: the capture has fewer than 101 frames",
        "7:39: levels.1.locate.fallback.1: the capture has fewer than 102 frames",
    ]


def test_check_stream_reports_default_stage_by_its_path(catalog):
    problems = check_stream(parse_spec({"version": 1, "source": {"use": "simulator"}}, catalog=catalog), SHORT)
    assert [str(problem) for problem in problems] == [f"resample: {TOO_LARGE.format(500)}"]


def test_check_stream_skips_stage_that_all_levels_override(catalog):
    levels = [{"resample": {"with": {"group_size": 50}}}]
    plan = parse_spec({"version": 1, "source": {"use": "simulator"}, "levels": levels}, catalog=catalog)
    assert check_stream(plan, SHORT) == []


class NoKeys(Config):
    pass


def fail(*_):
    raise ZeroDivisionError("oops")


@pytest.fixture
def careless(catalog):
    """Contributions whose checks raise, or return a bare text."""
    offers = [
        ResamplerContribution(name="careless", summary="Toy", config=NoKeys, build=fail, check=fail),
        ResamplerContribution(name="terse", summary="Toy", config=NoKeys, build=fail, check=lambda *_: "too dark"),
        SourceContribution(name="broken", summary="Toy", config=NoKeys, build=fail, check=fail),
    ]
    return Catalog(catalog.rows).including(*offers)


def test_check_that_raises_is_a_problem_with_the_plugins_name(careless):
    plan = parse_spec("version: 1\nsource: {use: simulator}\nresample: {use: careless}", catalog=careless)
    (problem,) = check_stream(plan, SHORT)
    raised = f"of {fail.__module__} unreleased raised ZeroDivisionError: oops"
    assert str(problem) == f"3:1: resample: the check of the resampler 'careless' {raised}"
    with pytest.raises(SpecError, match=r"the check of the source 'broken' of .* raised ZeroDivisionError: oops"):
        parse_spec("version: 1\nsource: {use: broken}", catalog=careless)


def test_check_that_returns_a_bare_text_is_one_problem(careless):
    plan = parse_spec("version: 1\nsource: {use: simulator}\nresample: {use: terse}", catalog=careless)
    assert [problem.message for problem in check_stream(plan, SHORT)] == ["too dark"]
