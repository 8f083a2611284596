"""What is checked of every contribution, on resamplers."""

from __future__ import annotations

import pytest
from pydantic import BaseModel, Field, field_serializer, model_validator

from photonpano import Config, FrameSpan, Group, Requirement, discover
from photonpano.testing import ResamplerConformance
from photonpano.testing.conformance import Conformance, models_in
from photonpano.testing.stages import StageConformance


class All:
    """One group of all frames."""

    def __init__(self, context):
        pass

    def groups(self, n_frames, level):
        span = FrameSpan(0, n_frames)
        return (Group(span, span.centre),)


class Impatient(All):
    def __init__(self, context):
        self.flux = context.capture().flux


class DecidesOnAnObject(All):
    def __init__(self, context):
        context.decide("size", object(), "so it is")


class Open(BaseModel):
    size: int = Field(3, description="frames")


class WithOpenPart(Config):
    part: Open | None = Field(None, description="what is open")


class Undescribed(Config):
    size: int = 3


class WithUndescribedParts(Config):
    parts: tuple[Undescribed, ...] = Field((), description="some parts")


class DropsTypingErrors(Config):
    """Passes over keys that it does not know."""

    @model_validator(mode="before")
    @classmethod
    def known(cls, keys):
        return {key: value for key, value in keys.items() if key in cls.model_fields}


class WritesUnits(Config):
    size: int = Field(3, description="frames")

    @field_serializer("size")
    def with_unit(self, size):
        return f"{size} frames"


def too_long(config, stream):
    return ["groups are longer than the capture"]


LOCATOR = discover().find("locator", "direct").contribution
BROKEN = [
    (
        "test_the_record_is_of_the_kind_that_this_class_tests",
        All,
        {"contribution": LOCATOR},
        "TestToy tests a resampler: .* got Loc",
    ),
    ("test_the_name_and_the_summary_fit_a_list", All, {"record": {"summary": "A toy "}}, "one line without spaces around it"),
    ("test_the_name_and_the_summary_fit_a_list", All, {"record": {"summary": "A toy."}}, "drop the full stop of 'A toy.'"),
    (
        "test_the_config_is_closed_and_frozen",
        All,
        {"record": {"config": WithOpenPart}},
        "Open must be closed and .* extra=None",
    ),
    ("test_every_key_of_the_config_is_described", All, {"record": {"config": WithUndescribedParts}}, "for Undescribed.size"),
    (
        "test_an_unknown_key_is_refused",
        All,
        {"record": {"config": DropsTypingErrors}},
        "must be refused, .* pydantic finds: nothing",
    ),
    (
        "test_an_unknown_key_is_refused",
        All,
        {"config": {"size": 3}},
        "pydantic finds: size: Extra inputs .*, no-such-key: Extra",
    ),
    (
        "test_the_config_comes_back_from_a_run_record",
        All,
        {"record": {"config": WritesUnits}},
        "'3 frames'.* must not raise; it raised Valid",
    ),
    (
        "test_the_hook_module_imports_nothing_heavy",
        All,
        {"hook_module": "hooks_with_scipy"},
        "importing hooks_with_scipy imports scipy",
    ),
    (
        "test_the_hook_module_imports_nothing_heavy",
        All,
        {"hook_module": "there_is_none"},
        "there_is_none.* cannot be imported in a",
    ),
    (
        "test_the_hook_module_imports_nothing_heavy",
        All,
        {"hook_module": "hooks_with_wave", "record": {"requires": (Requirement("wave", "wave"),)}},
        "importing hooks_with_wave imports wave; move that import into the function `build`",
    ),
    (
        "test_it_is_built_before_any_frame_is_read",
        Impatient,
        {},
        "asks context.capture.., ask when|asks context.capture..; ask when",
    ),
    ("test_it_is_built_before_any_frame_is_read", DecidesOnAnObject, {}, "the value of 'size' is a object"),
    ("test_it_is_built_before_any_frame_is_read", lambda _: "a text", {}, "must be a resampler; str has no groups"),
    (
        "test_check_finds_no_problem_with_the_config_under_test",
        All,
        {"record": {"check": too_long}},
        "says: groups are longer than",
    ),
    (
        "test_check_finds_no_problem_with_the_config_under_test",
        All,
        {"record": {"check": lambda *_: "too long"}},
        "a sequence of sentences, got the text 'too long'",
    ),
]


@pytest.fixture(autouse=True)
def hook_modules(tmp_path, monkeypatch):
    (tmp_path / "hooks_with_scipy.py").write_text("import scipy\n")
    (tmp_path / "hooks_with_wave.py").write_text("import wave\n")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize(("check", "broken", "more", "words"), BROKEN)
def test_it_is_caught(check, broken, more, words, catches):
    catches(ResamplerConformance, check, broken, words, **more)


def test_every_check_catches_something(checks_of):
    assert checks_of(StageConformance) == {check for check, *_ in BROKEN}


def test_an_honest_one_passes(checks_of, complaint):
    """It is built by a function of a test, which is imported as a file."""
    for check in checks_of(StageConformance):
        assert complaint(ResamplerConformance, check, All) is None, check
    assert checks_of(Conformance) < checks_of(StageConformance)


def test_a_component_whose_library_is_missing_is_not_tested(complaint):
    missing = {"requires": (Requirement("no_such_library", "photonpano[none]"),)}
    with pytest.raises(pytest.skip.Exception, match=r"toy needs no_such_library: pip install photonpano\[none\]"):
        complaint(ResamplerConformance, "test_groups_lie_inside_the_capture", All, record=missing)


def test_models_are_found_wherever_they_stand():
    assert models_in(WithUndescribedParts) == [WithUndescribedParts, Undescribed]
    assert models_in(WithOpenPart) == [WithOpenPart, Open]
