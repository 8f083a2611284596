"""What becomes of a spec: defaults, corrections and outcomes."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from ruamel.yaml import YAML, YAMLError

from photonpano import Config, ExporterContribution, SpecError
from photonpano.plugins.registry import Catalog
from photonpano.specs import json_schema, load_spec, parse_spec

MINIMAL = {"version": 1, "source": {"use": "simulator"}}


def messages(spec, **settings):
    with pytest.raises(SpecError) as caught:
        parse_spec(spec, **settings)
    return [str(problem) for problem in caught.value.problems]


def test_minimal_spec_is_complete(catalog):
    plan = parse_spec(MINIMAL, catalog=catalog)
    first, second, third = plan.levels
    names = [choice.contribution.name for choice in (first.resample, first.merge, first.locate, first.interpolate)]
    assert names == ["midpoint", "photon-mle", "direct", "smoothing-spline"]
    assert [choice.contribution.name for choice in first.fallbacks] == ["opencv-sift"]
    assert [choice.contribution.name for choice in (*plan.refine, plan.renderer, *plan.formats)] == ["short-spans", "merge"]
    assert (plan.source.origin.plugin, plan.source.origin.version) == ("photonpano", "0.1.0")
    assert first.locate is second.locate is third.locate
    assert {level.scale for level in plan.levels} == {"auto"}
    assert list(plan.document)[:8] == [
        *("version", "source", "corrections", "resample", "merge", "locate", "interpolate", "refine")
    ]
    converged = parse_spec(MINIMAL | {"levels": "until-converged"}, catalog=catalog)
    assert (converged.until_converged, converged.levels) == (True, (converged.levels[0],) * 8)
    assert not parse_spec(MINIMAL | {"levels": 8}, catalog=catalog).until_converged


@pytest.mark.parametrize(
    ("gone", "sections", "problem"),
    [
        ("opencv-sift", {}, None),
        ("opencv-sift", {"locate": {"use": "chain-of-backends"}}, "locate.use: there is no locator 'opencv-sift'; known: "),
        ("short-spans", {}, None),
        ("short-spans", {"refine": "short-spans"}, "refine: there is no refiner 'short-spans'; known: drift"),
    ],
)
def test_default_that_is_not_installed_is_left_out_unless_it_is_named(gone, sections, problem, catalog):
    without = Catalog(tuple(entry for entry in catalog.rows if entry.name != gone))
    if problem is None:
        plan = parse_spec(MINIMAL | sections, catalog=without)
        assert (plan.levels[0].fallbacks, plan.refine).count(()) == 1
    else:
        (message,) = messages(MINIMAL | sections, catalog=without)
        assert message.startswith(problem)


@pytest.mark.parametrize(
    ("suffix", "message"),
    [
        ("exr", "toy: suffix is a dot and small letters or digits, such as .exr, got 'exr'"),
        (".E/r", "toy: suffix is a dot and small letters or digits, such as .exr, got '.E/r'"),
        (".tiff", "toy: every run writes panorama.tiff itself; choose another suffix"),
    ],
)
def test_exporter_refuses_suffix_that_is_no_file_of_its_own(suffix, message):
    with pytest.raises(ValueError, match="toy") as caught:
        ExporterContribution(name="toy", summary="Toy", config=Config, suffix=suffix, build=lambda *_: None)
    assert str(caught.value) == message


def test_paths_count_from_the_folder_of_the_spec(catalog, tmp_path, monkeypatch):
    (tmp_path / "specs").mkdir()
    (tmp_path / "cube.npy").touch()
    path = tmp_path / "specs" / "scan.yaml"
    path.write_text("version: 1\nsource: {use: packed-npy, with: {path: ../cube.npy}}\n")
    monkeypatch.chdir(tmp_path)
    plan = load_spec("specs/scan.yaml", catalog=catalog)
    assert plan.source.config.path == tmp_path / "specs" / ".." / "cube.npy"
    assert plan.output.directory == tmp_path / "specs" / "runs" / "scan"
    assert plan.document["output"] == {"directory": str(plan.output.directory), "formats": [], "keep": None}


def test_output_counts_from_the_current_folder(catalog, tmp_path, monkeypatch):
    path = tmp_path / "specs" / "scan.yaml"
    path.parent.mkdir()
    path.write_text("version: 1\nsource: {use: simulator}\noutput: {directory: elsewhere}\n")
    monkeypatch.chdir(tmp_path)
    assert load_spec(path, output="mine", catalog=catalog).output.directory == tmp_path / "mine"
    assert load_spec(path, catalog=catalog).output.directory == tmp_path / "specs" / "elsewhere"


def test_default_run_folder_follows_a_capture_that_is_chosen_by_override(catalog, tmp_path):
    path = tmp_path / "scan.yaml"
    path.write_text("version: 1\nsource: {use: packed-npy, with: {path: cube.npy}}\n")

    def folder(*overrides):
        return load_spec(path, overrides, catalog=catalog).output.directory.relative_to(tmp_path)

    for capture in ("cube.npy", "other.npy", "night/cube.npy", "day/cube.npy"):
        (tmp_path / capture).parent.mkdir(exist_ok=True)
        (tmp_path / capture).touch()
    assert folder() == folder("source.with.path=cube.npy") == Path("runs/scan")
    assert folder("source.with.path=other.npy") == Path("runs/scan-other")
    assert folder("source.with.path=night/cube.npy") == Path("runs/scan-night-cube")
    assert folder(f"source.with.path={tmp_path}/day/cube.npy") == Path("runs/scan-day-cube")
    assert folder("source.with.path=other.npy", f"output.directory={tmp_path}/mine") == Path("mine")


def test_problems_of_python_data_have_no_lines(catalog):
    spec = {"version": 1, "source": {"use": "simulator", "with": {"flux": np.zeros(2)}}, 5: 6, "run": {"seed": -1}}
    assert messages(spec, catalog=catalog) == [
        "source.with.flux: expected plain data (text, numbers, lists, mappings), got a ndarray",
        "a key is text, got 5",
        "run.seed: expected an integer of at least 0, got -1",
    ]


def test_parse_spec_reads_text_as_yaml(catalog):
    plan = parse_spec("version: 1\nsource: {use: simulator}", directory="/captures", name="night", catalog=catalog)
    assert plan.output.directory == Path("/captures/runs/night")
    assert messages("version: 1\nsource: {use: 3}", catalog=catalog) == [
        "2:15: source.use: expected the name of the source, got 3"
    ]


def test_load_spec_of_other_file_is_an_error(catalog, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("folder.yaml").mkdir()
    Path("null.yaml").write_text("---\n...\n")
    Path("deep.yaml").write_text("a: " + "[" * 2000)
    Path("long.yaml").write_text("#" * 2**18 + "\n")
    Path("utf16.yaml").write_text("version: 1\n", encoding="utf-16-le")
    Path("bom16.yaml").write_text("version: 1\n", encoding="utf-16")
    told = {}
    for path in ("missing.yaml", *sorted(path.name for path in tmp_path.iterdir())):
        with pytest.raises(SpecError) as caught:
            load_spec(path, catalog=catalog)
        told[path] = str(caught.value)
    assert told == {
        "missing.yaml": "missing.yaml: there is no such file",
        "folder.yaml": "folder.yaml: this is a folder, expected a spec in YAML",
        "long.yaml": "long.yaml: not a spec: longer than 262144 bytes",
        "null.yaml": "null.yaml:2:1: the spec is empty; it needs at least `version` and `source`",
        "deep.yaml": "deep.yaml: not a spec: nested too deeply; does an alias stand in the value that it repeats?",
        "utf16.yaml": "utf16.yaml:1:2: not valid YAML: special characters are not allowed, got the character 0x00",
        "bom16.yaml": "bom16.yaml:1:1: not UTF-8 text, got the byte 0xff; save the file as UTF-8",
    }


def spec(*corrections: Any) -> dict[str, Any]:
    return {"version": 1, "source": {"use": "simulator"}, "corrections": list(corrections)}


def test_missing_correction_file_is_an_error_at_its_place(catalog: Catalog, tmp_path: Path) -> None:
    path = tmp_path / "scan.yaml"
    path.write_text(
        "version: 1\n"
        "source: {use: simulator}\n"
        "corrections:\n"
        "  - mask: {file: bad.npy}\n"
        "  - dark-counts:\n"
        "      dark: dark.npz\n"
        "  - hot-pixels\n"
    )
    with pytest.raises(SpecError) as caught:
        load_spec(path, catalog=catalog)
    assert str(caught.value) == (
        f"{path}:4:18: corrections.0.mask.file: there is no file {tmp_path / 'bad.npy'}; check the path\n"
        f"{path}:6:13: corrections.1.dark-counts.dark: there is no file {tmp_path / 'dark.npz'}; check the path"
    )


@pytest.mark.parametrize(("written", "still"), [({}, True), ({"corrections": "auto"}, True), ({"corrections": []}, False)])
def test_still_pixels_are_masked_unless_corrections_are_listed(written: dict[str, Any], still: bool, catalog: Catalog) -> None:
    plan = parse_spec({"version": 1, "source": {"use": "simulator"}} | written, catalog=catalog)
    assert (plan.corrections, plan.corrects_itself) == ((), still)
    assert parse_spec(plan.document, catalog=catalog).corrects_itself == still
    assert list(plan.document)[:3] == ["version", "source", "corrections"]


SPECS = Path(__file__).parents[2] / "specs"
GOOD = sorted((SPECS / "good").glob("*.yaml"))
BAD = sorted((SPECS / "bad").glob("*.yaml"))
BEYOND_A_SCHEMA = {
    "fallback_again",
    "gyroscope",
    "gyroscope_axes",
    "lens_of_homographies",
    "projection_of_homographies",
    "source_check",
    "start_of_rotations",
    "validator",
}
"""What is wrong here is not wrong by its shape; the files that are no YAML are left out by themselves."""


def name(path):
    return path.stem


def data(path):
    """Return what an editor sees, None where there is no document to check."""
    try:
        return YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except (YAMLError, UnicodeDecodeError, ValueError, TypeError, RecursionError):
        return None


@pytest.fixture(scope="module")
def validator(catalog):
    schema = json_schema(catalog)
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("path", BAD, ids=name)
def test_bad_spec_gives_exactly_these_messages(path, catalog, monkeypatch):
    monkeypatch.chdir(path.parent)
    with pytest.raises(SpecError) as caught:
        load_spec(path.name, catalog=catalog)
    assert f"{caught.value}\n" == path.with_suffix(".txt").read_text(encoding="utf-8")
    assert {problem.file for problem in caught.value.problems} == {Path(path.name)}


@pytest.mark.parametrize("path", GOOD, ids=name)
def test_good_spec_resolves_to_document_that_resolves_to_itself(path, catalog, validator):
    plan = load_spec(path, catalog=catalog)
    again = parse_spec(json.loads(json.dumps(plan.document)), catalog=catalog)
    assert again.document == plan.document
    assert (
        again.source,
        again.corrections,
        again.levels,
        again.refine,
        again.graph,
        again.render,
        again.output,
        again.run,
    ) == ((plan.source, plan.corrections, plan.levels, plan.refine, plan.graph, plan.render, plan.output, plan.run))
    validator.validate(plan.document)


@pytest.mark.parametrize("path", GOOD, ids=name)
def test_good_spec_is_valid_for_editors(path, validator):
    validator.validate(data(path))


@pytest.mark.parametrize("path", BAD, ids=name)
def test_bad_spec_is_marked_by_editors(path, validator):
    document = data(path)
    if document is not None:
        assert validator.is_valid(document) == (path.stem in BEYOND_A_SCHEMA)


def test_capture_that_no_source_recognises_is_refused_as_a_capture(tmp_path: Path) -> None:
    np.save(tmp_path / "none.npy", np.zeros((0, 8, 2), np.uint8))
    with pytest.raises(SpecError, match=r"packed-npy: none\.npy is empty"):
        load_spec(tmp_path / "none.npy")


def test_comma_in_a_number_is_named(catalog: Catalog, tmp_path: Path) -> None:
    text = "version: 1\nsource: {use: packed-npy, with: {path: a.npy, frame_rate_hz: 96,800}}\n"
    with pytest.raises(SpecError, match=r"got 800; in \{...\}, a comma ends a value: write numbers without commas"):
        parse_spec(text, catalog=catalog)
