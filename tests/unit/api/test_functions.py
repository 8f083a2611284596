"""Commands as functions: what the tests of the command line do not show."""

import inspect
from pathlib import Path

import numpy as np
import pytest

import photonpano
from photonpano import (
    Config,
    OutputError,
    Plan,
    RefinerContribution,
    capture_plan,
    convert,
    discover,
    explain,
    info,
    load_spec,
    parse_spec,
)
from photonpano.api.cli.app import commands
from photonpano.record.run_json import plugin_records


@pytest.fixture
def capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plan:
    """A packed capture in the current folder: 40 binary frames of 8 x 13 px."""
    monkeypatch.chdir(tmp_path)
    np.save("cube.npy", np.packbits(np.random.default_rng(0).random((40, 8, 13)) < 0.3, axis=-1))
    return capture_plan("cube.npy", {"width": 13, "frame_rate_hz": 100})


@pytest.mark.parametrize("name", ["preview", "dark", "evaluate", "convert", "simulate"])
def test_function_has_defaults_of_command(name: str) -> None:
    command = commands()[name]
    options = {each.name: each.default for each in command.params if each.default is not None}
    parameters = inspect.signature(getattr(photonpano, name)).parameters
    defaults = {key: each.default for key, each in parameters.items() if each.default not in (None, each.empty)}
    assert {key: options[key] for key in defaults} == defaults


def test_convert_returns_spec_section_that_reads_the_file(capture: Plan) -> None:
    written = convert(capture, "copy.npy")
    assert (written.path, written.truth, written.n_masked) == (Path("copy.npy"), None, 0)
    assert str(written.info) == "40 binary frames of 8x13 at 100 Hz"
    plan = parse_spec({"version": 1, "source": written.source})
    assert (plan.source.config.width, plan.source.config.frame_rate_hz) == (13, 100)


def test_refiners_are_explained_and_recorded_with_their_plugins(capture: Plan) -> None:
    class Drift(Config):
        knots: int = 4

    drift = RefinerContribution(name="drift", summary="Toy", config=Drift, build=lambda *_: None)
    catalog = discover().including(drift)
    spec = {**capture.document, "resample": {"with": {"group_size": 8}}, "refine": []}
    plan = parse_spec(spec, overrides=["refine=[drift, {use: drift, with: {knots: 9}}]"], catalog=catalog)
    lines = explain(plan, catalog=catalog).splitlines()
    start = lines.index("refine:")
    assert lines[start : start + 7] == [
        "refine:",
        f"  - use: drift  # {__name__} unreleased, --set",
        "    with:",
        "      knots: 4  # default",
        f"  - use: drift  # {__name__} unreleased, --set",
        "    with:",
        "      knots: 9  # --set",
    ]
    assert [each for each in plugin_records(plan) if each["stage"] == "refine"] == [
        {"stage": "refine", "use": "drift", "plugin": __name__, "version": "unreleased"}
    ]
    assert "refine: []  # default" in explain(parse_spec(spec)).splitlines()


def test_info_writes_a_spec_to_start_from(capture: Plan, tmp_path: Path) -> None:
    """Its paths count from its own folder."""
    Path("specs").mkdir()
    for file, path in (("scan.yaml", "cube.npy"), ("specs/scan.yaml", str(tmp_path / "cube.npy"))):
        found = info(capture, write=file)
        assert found.spec["source"]["with"] == {"path": path, "width": 13, "frame_rate_hz": 100}
        assert Path(file).read_text() == found.spec_yaml + "\n"
        assert load_spec(file).source.config == capture.source.config
    with pytest.raises(OutputError, match="is there already; choose another name, or replace it with --overwrite"):
        info(capture, write="scan.yaml")
