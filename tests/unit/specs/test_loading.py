"""Files and Python data on their way to a plan."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from photonpano import SpecError
from photonpano.registry import Catalog
from photonpano.registry.description import snippet
from photonpano.specs import load_spec, parse_spec

MINIMAL = {"version": 1, "source": {"use": "simulator"}}


def messages(spec, **settings):
    with pytest.raises(SpecError) as caught:
        parse_spec(spec, **settings)
    return [str(problem) for problem in caught.value.problems]


def test_minimal_spec_is_complete(catalog):
    plan = parse_spec(MINIMAL, catalog=catalog)
    assert len(plan.levels) == 3
    level = plan.levels[0]
    names = [choice.contribution.name for choice in (level.resample, level.merge, level.locate, level.interpolate)]
    assert names == ["midpoint", "photon-mle", "direct", "smoothing-spline"]
    assert [choice.contribution.name for choice in level.fallbacks] == ["opencv-sift"]
    assert (plan.source.origin.plugin, plan.source.origin.version) == ("photonpano", "0.1.0")
    assert {level.scale for level in plan.levels} == {"auto"}


def test_levels_without_overrides_share_their_choices(catalog):
    plan = parse_spec(MINIMAL | {"levels": [{"scale": 0.5}, {}]}, catalog=catalog)
    assert [level.scale for level in plan.levels] == [0.5, "auto"]
    assert plan.levels[0].locate is plan.levels[1].locate


def test_until_converged_is_eight_equal_levels(catalog):
    plan = parse_spec(MINIMAL | {"levels": "until-converged"}, catalog=catalog)
    assert plan.until_converged
    assert plan.levels == (plan.levels[0],) * 8
    assert plan.document["levels"] == "until-converged"
    assert not parse_spec(MINIMAL | {"levels": 8}, catalog=catalog).until_converged


def test_level_replaces_a_stage_with_use_and_updates_it_without(catalog):
    levels = [{"locate": {"use": "direct"}}, {"locate": {"with": {"ratio": 0.6}}}, {}, {"locate": None}]
    spec = MINIMAL | {"locate": {"use": "opencv-sift", "with": {"max_keypoints": 99}}, "levels": levels}
    replaced, updated, base, empty = (level.locate for level in parse_spec(spec, catalog=catalog).levels)
    assert replaced.contribution.name == "direct"
    assert (updated.config.ratio, updated.config.max_keypoints) == (0.6, 99)
    assert (base.config.ratio, base.config.max_keypoints) == (0.8, 99)
    assert empty == base


def tried_by(level):
    return [(each.contribution.name, each.config.model_dump(exclude_unset=True)) for each in (level.locate, *level.fallbacks)]


@pytest.mark.parametrize(
    ("section", "tried"),
    [
        (None, ["direct", "opencv-sift"]),
        ({"with": {"max_steps": 5}}, ["direct", "opencv-sift"]),
        ({"fallback": None}, ["direct", "opencv-sift"]),
        ({"fallback": []}, ["direct"]),
        ({"fallback": {"use": "direct", "with": {"max_steps": 5}}}, ["direct", "direct"]),
        ({"use": "direct"}, ["direct"]),
        ({"use": "opencv-sift"}, ["opencv-sift"]),
        ({"use": "opencv-sift", "fallback": "direct"}, ["opencv-sift", "direct"]),
    ],
)
def test_only_the_default_locator_has_a_default_fallback(section, tried, catalog):
    plan = parse_spec(MINIMAL | {"locate": section}, catalog=catalog)
    assert [[name for name, _ in tried_by(level)] for level in plan.levels] == [tried] * 3
    assert [each["use"] for each in plan.document["locate"]["fallback"]] == tried[1:]


def test_level_that_overrides_keys_keeps_the_default_fallback_and_one_that_names_a_locator_has_none(catalog):
    levels = [{"locate": {"with": {"max_steps": 5}}}, {"locate": {"use": "direct"}}, {"locate": {"fallback": []}}]
    plan = parse_spec(MINIMAL | {"levels": levels}, catalog=catalog)
    short = ("direct", {"max_steps": 5})
    assert [tried_by(level) for level in plan.levels] == [[short, ("opencv-sift", {})], [("direct", {})], [("direct", {})]]


def test_default_fallback_is_left_out_where_it_is_not_installed_and_an_error_where_it_is_ambiguous(catalog):
    without = Catalog(tuple(entry for entry in catalog.rows if entry.name != "opencv-sift"))
    assert parse_spec(MINIMAL, catalog=without).levels[0].fallbacks == ()
    twice = Catalog((*catalog.rows, catalog.find("locator", "opencv-sift")))
    (message,) = messages(MINIMAL | {"levels": [{"locate": {"with": {"max_steps": 5}}}]}, catalog=twice)
    assert message.startswith("locate.fallback.0.use: the locator 'opencv-sift' is offered by ")
    parse_spec(MINIMAL | {"locate": {"fallback": []}}, catalog=twice)


def test_level_keeps_the_fallbacks_until_it_names_a_locator_or_fallbacks_of_its_own(catalog):
    steps = {"max_steps": 5}
    overrides = {
        "nothing": {},
        "null": {"fallback": None},
        "keys": {"with": {"ratio": 0.6}},
        "locator": {"use": "direct"},
        "fallback": {"fallback": {"use": "direct", "with": steps}},
        "both": {"use": "direct", "fallback": ["opencv-sift", {"use": "direct", "with": steps}]},
        "none": {"fallback": []},
    }
    levels = [{"locate": override} for override in overrides.values()]
    plan = parse_spec(MINIMAL | {"locate": {"use": "opencv-sift", "fallback": "direct"}, "levels": levels}, catalog=catalog)
    tried = {name: tried_by(level) for name, level in zip(overrides, plan.levels, strict=True)}
    sift, direct, short = ("opencv-sift", {}), ("direct", {}), ("direct", steps)
    assert tried == {
        "nothing": [sift, direct],
        "null": [sift, direct],
        "keys": [("opencv-sift", {"ratio": 0.6}), direct],
        "locator": [direct],
        "fallback": [sift, short],
        "both": [direct, sift, short],
        "none": [sift],
    }
    assert "locate" not in plan.document["levels"][0]
    assert plan.document["levels"][3]["locate"]["fallback"] == []


@pytest.mark.parametrize(
    ("written", "chosen"),
    [
        (None, ["short-spans"]),
        ([], []),
        ("drift", ["drift"]),
        ({"use": "drift"}, ["drift"]),
        (["drift", {"use": "short-spans"}, "drift"], ["drift", "short-spans", "drift"]),
    ],
)
def test_refiners_are_a_list_in_order_and_short_spans_by_default(written, chosen, catalog):
    plan = parse_spec(MINIMAL | {"refine": written}, catalog=catalog)
    assert [choice.contribution.name for choice in plan.refine] == chosen
    assert [each["use"] for each in plan.document["refine"]] == chosen
    assert list(plan.document)[6:9] == ["interpolate", "refine", "levels"]


def test_snippet_of_a_refiner_is_a_section_of_a_spec(catalog):
    drift = catalog.find("refiner", "drift").contribution
    assert snippet(drift) == "refine:\n  use: drift\n  with:\n    knots: 4  # of the spline\n"
    plan = parse_spec(f"version: 1\nsource: {{use: simulator}}\n{snippet(drift)}", catalog=catalog)
    assert [choice.contribution for choice in plan.refine] == [drift]


def test_default_refiner_is_left_out_where_it_is_not_installed(catalog):
    without = Catalog(tuple(entry for entry in catalog.rows if entry.name != "short-spans"))
    assert parse_spec(MINIMAL, catalog=without).refine == ()
    (message,) = messages(MINIMAL | {"refine": "short-spans"}, catalog=without)
    assert message == "refine.0.use: there is no refiner 'short-spans'; known: drift"


def test_places_of_refiners_are_found_by_their_paths_in_the_document(catalog):
    spec = "version: 1\nsource: {use: simulator}\nrefine: {use: drift, with: {knots: 5}}"
    places = parse_spec(spec, catalog=catalog).places
    assert (places["refine.0.use"].column, places["refine.0.with.knots"].column) == (10, 29)
    places = parse_spec(spec.replace("{use: drift, with: {knots: 5}}", "[drift, short-spans]"), catalog=catalog).places
    assert (places["refine.0.use"].column, places["refine.1.use"].column) == (10, 17)


def test_places_of_fallbacks_are_found_by_their_paths_in_the_document(catalog):
    """Where a fallback is one name or one mapping, the document has a list of mappings."""
    spec = (
        "version: 1\nsource: {use: simulator}\n"
        "locate: {fallback: opencv-sift}\nlevels: [{locate: {fallback: {use: opencv-sift}}}]"
    )
    places = parse_spec(spec, catalog=catalog).places
    found = {path: (places[path].where, places[path].column) for path in places if path.endswith(".0.use")}
    assert found == {
        "locate.fallback.0.use": ("locate.fallback", 10),
        "levels.0.locate.fallback.0.use": ("levels.0.locate.fallback.use", 31),
    }


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


def test_parse_spec_accepts_numpy_numbers_tuples_and_paths(catalog, tmp_path):
    source = {"use": "simulator", "with": {"flux": np.float32(0.5), "n_frames": np.int64(7), "size": (3, 4)}}
    plan = parse_spec({"version": 1, "source": source, "output": {"directory": tmp_path}}, catalog=catalog)
    assert (plan.source.config.flux, plan.source.config.n_frames, plan.source.config.size) == (0.5, 7, (3, 4))
    assert plan.output.directory == tmp_path


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
    Path("deep.yaml").write_text("a: " + "[" * 500)
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
        "deep.yaml": "deep.yaml: not a spec: nested too deeply",
        "utf16.yaml": "utf16.yaml:1:2: not valid YAML: special characters are not allowed, got the character 0x00",
        "bom16.yaml": "bom16.yaml:1:1: not UTF-8 text, got the byte 0xff; save the file as UTF-8",
    }


def test_load_spec_of_unreadable_file_is_an_error(catalog, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("loop.yaml").symlink_to("loop.yaml")
    with pytest.raises(SpecError, match=r"^loop\.yaml: cannot be read: "):
        load_spec("loop.yaml", catalog=catalog)


def test_load_spec_accepts_byte_order_mark_and_windows_line_ends(catalog, tmp_path):
    path = tmp_path / "scan.yaml"
    path.write_bytes(b"\xef\xbb\xbfversion: 1\r\nsource: {use: simulator}\r\nrun: {seed: x}\r\n")
    with pytest.raises(SpecError, match=r"scan\.yaml:3:13: run\.seed"):
        load_spec(path, catalog=catalog)


def test_reading_specs_imports_nothing_heavy():
    code = (
        "import sys, photonpano.specs, photonpano.registry\n"
        "heavy = {'cv2', 'scipy', 'skimage', 'matplotlib', 'tifffile', 'PIL', 'jinja2', 'torch'}\n"
        "sys.exit(', '.join(sorted(heavy & sys.modules.keys())) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
