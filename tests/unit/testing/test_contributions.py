"""Checks of every contribution, run on resamplers."""

import pytest
from pydantic import BaseModel, Field, field_serializer, model_validator

from photonpano import Config, FrameSpan, Group, Requirement, discover
from photonpano.testing import ResamplerConformance
from photonpano.testing.conformance import Conformance, models_in
from photonpano.testing.stages import StageConformance

from .test_behaviours import GOLDEN, check_of


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
    """Ignores unknown keys."""

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
# By the check that finds each, and behind a comma what is broken; what is said of each stands in behaviours.txt.
BROKEN = {
    "contribution_has_the_kind_of_this_class": (All, {"contribution": LOCATOR}),
    "summary_is_one_line_without_full_stop, a space": (All, {"record": {"summary": "A toy "}}),
    "summary_is_one_line_without_full_stop, a full stop": (All, {"record": {"summary": "A toy."}}),
    "config_is_closed_and_frozen": (All, {"record": {"config": WithOpenPart}}),
    "config_keys_have_descriptions": (All, {"record": {"config": WithUndescribedParts}}),
    "config_refuses_unknown_key, drops it": (All, {"record": {"config": DropsTypingErrors}}),
    "config_refuses_unknown_key, unknown already": (All, {"config": {"size": 3}}),
    "config_survives_json_round_trip": (All, {"record": {"config": WritesUnits}}),
    "hooks_of_module_can_be_called, without end": (All, {"hook_module": "hooks_without_end"}),
    "hooks_of_module_can_be_called, fails": (All, {"hook_module": "hooks_that_fail"}),
    "hook_module_imports_no_heavy_library, scipy": (All, {"hook_module": "hooks_with_scipy"}),
    "hook_module_imports_no_heavy_library, absent": (All, {"hook_module": "there_is_none"}),
    "hook_module_imports_no_heavy_library, its own": (
        All,
        {"hook_module": "hooks_with_wave", "record": {"requires": (Requirement("wave", "wave"),)}},
    ),
    "build_reads_no_frames, reads": (Impatient, {}),
    "build_reads_no_frames, decides on an object": (DecidesOnAnObject, {}),
    "build_reads_no_frames, no resampler": (lambda _: "a text", {}),
    "check_accepts_config_under_test, refuses": (All, {"record": {"check": too_long}}),
    "check_accepts_config_under_test, a text": (All, {"record": {"check": lambda *_: "too long"}}),
}


@pytest.fixture(autouse=True)
def hook_modules(tmp_path, monkeypatch):
    (tmp_path / "hooks_with_scipy.py").write_text("import scipy\n")
    for name, work in (("without_end", "return repeat(None)"), ("that_fail", "return 1 / 0")):
        code = f"from itertools import repeat\nfrom photonpano import hookimpl\n@hookimpl\ndef photonpano_sources(): {work}\n"
        (tmp_path / f"hooks_{name}.py").write_text(code)
    (tmp_path / "hooks_with_wave.py").write_text("import wave\n")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("name", BROKEN)
def test_check_fails_on_broken_component(name, catches):
    broken, more = BROKEN[name]
    catches(ResamplerConformance, check_of(name), broken, GOLDEN[f"contribution, {name}"], **more)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(StageConformance) == set(map(check_of, BROKEN))


def test_checks_pass_on_correct_component(checks_of, failure):
    """Its build function is defined in a test, whose module is run as a file."""
    for check in checks_of(StageConformance):
        assert failure(ResamplerConformance, check, All) is None, check
    assert checks_of(Conformance) < checks_of(StageConformance)


def test_check_is_skipped_if_library_is_missing(failure):
    missing = {"requires": (Requirement("no_such_library", "photonpano[none]"),)}
    with pytest.raises(pytest.skip.Exception, match=r'toy needs no_such_library: pip install "photonpano\[none\]"'):
        failure(ResamplerConformance, "test_groups_returns_tuple", All, record=missing)


def test_models_in_finds_nested_models():
    assert models_in(WithUndescribedParts) == [WithUndescribedParts, Undescribed]
    assert models_in(WithOpenPart) == [WithOpenPart, Open]
