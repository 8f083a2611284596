"""`output.formats`: the exporters that write further files of the panorama."""

import pytest

from photonpano import Config, ExporterContribution, Requirement, SpecError
from photonpano.specs import parse_spec

MINIMAL = {"version": 1, "source": {"use": "simulator"}}


class Keys(Config):
    """No keys."""


def exporter(name, suffix, **more):
    return ExporterContribution(name=name, summary="Toy", config=Keys, suffix=suffix, build=lambda *_: None, **more)


@pytest.fixture
def formats(catalog):
    missing = Requirement("there_is_no_such_module", "photonpano[exr]")
    return catalog.including(
        exporter("hdr", ".hdr"),
        exporter("radiance", ".hdr"),
        exporter("pgm", ".pgm"),
        exporter("exr", ".exr", requires=(missing,)),
    )


def plan_of(written, catalog):
    return parse_spec(MINIMAL | {"output": {"formats": written}}, catalog=catalog)


def test_formats_are_none_by_default(formats):
    plan = parse_spec(MINIMAL, catalog=formats)
    assert plan.formats == ()
    assert plan.document["output"]["formats"] == []


@pytest.mark.parametrize("written", [["hdr", "pgm"], [{"use": "hdr"}, {"use": "pgm", "with": {}}]])
def test_formats_are_names_or_mappings_and_are_read_back_from_the_record(formats, written):
    plan = plan_of(written, formats)
    assert [choice.contribution.name for choice in plan.formats] == ["hdr", "pgm"]
    again = parse_spec(plan.document, catalog=formats)
    assert (again.formats, again.document) == (plan.formats, plan.document)


def test_one_format_may_stand_without_a_list(formats):
    assert [choice.contribution.name for choice in plan_of("hdr", formats).formats] == ["hdr"]


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (["hrd"], "output.formats.0: there is no exporter 'hrd'; did you mean 'hdr'?"),
        (["pgm", "hdr", "radiance"], "output.formats.2: 'radiance' writes panorama.hdr, as 'hdr' does; keep one of them"),
        (
            ["exr"],
            "output.formats.0: the exporter 'exr' needs there_is_no_such_module, which is not installed: "
            'pip install "photonpano[exr]" (in a checkout: pip install ".[exr]")',
        ),
        ([{"use": "hdr", "with": {"bits": 8}}], "output.formats.0.with.bits: unknown key; no keys are allowed here"),
        ([8], "output.formats.0: expected the name of an exporter, or a mapping such as {use: NAME}, got 8"),
    ],
)
def test_wrong_format_is_one_problem(formats, written, message):
    with pytest.raises(SpecError) as caught:
        plan_of(written, formats)
    assert [str(problem).replace(".0.use:", ".0:") for problem in caught.value.problems] == [message]


@pytest.mark.parametrize(
    ("suffix", "message"),
    [
        ("exr", "toy: suffix is a dot and small letters or digits, such as .exr, got 'exr'"),
        (".E/r", "toy: suffix is a dot and small letters or digits, such as .exr, got '.E/r'"),
        (".tiff", "toy: every run writes panorama.tiff itself; choose another suffix"),
    ],
)
def test_contribution_refuses_suffix_that_is_no_file_of_its_own(suffix, message):
    with pytest.raises(ValueError, match="toy") as caught:
        exporter("toy", suffix)
    assert str(caught.value) == message
