"""The examples of the hooks on the page of the reference, which plugin authors copy, work."""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import Config, FrameSpan, Group, SpecError, run
from photonpano.plugins import hookspecs, registry
from photonpano.plugins.registry import OBSERVATION_HOOKS, contributions_of, discover, observation_of
from photonpano.specs import parse_spec
from photonpano.specs.settings import PANORAMA_ONLY
from photonpano.testing import ExporterConformance, RefinerConformance, RendererConformance, ResamplerConformance
from photonpano.testing.conformance import Conformance

pytestmark = pytest.mark.usefixtures("without_report")

PAGE = "docs/reference/plugins.md"
TEXT = (Path(__file__).parents[2] / PAGE).read_text(encoding="utf-8")
SECTIONS = re.findall(r"^## `(photonpano_\w+)`\n(.*?)(?=^## |\Z)", TEXT, re.MULTILINE | re.DOTALL)

HOOKS = {name: hook for name, hook in vars(hookspecs).items() if name.startswith("photonpano_")}
KINDS = {
    "photonpano_sources": ("source", "my-camera"),
    "photonpano_resamplers": ("resampler", "halves"),
    "photonpano_mergers": ("merger", "naive-sum"),
    "photonpano_locators": ("locator", "never-found"),
    "photonpano_interpolators": ("interpolator", "nearest"),
    "photonpano_refiners": ("refiner", "jump"),
    "photonpano_renderers": ("renderer", "nearest-pixel"),
    "photonpano_exporters": ("exporter", "pgm"),
    "photonpano_run_kinds": ("run-kind", "brightnesses"),
    "photonpano_executors": ("executor", "one-by-one"),
}


OBSERVED = {
    "photonpano_run_started": "runs/scan: begins with simulator, seed 3\n",
    "photonpano_stage_finished": "level 2: locate took 1.5 s\n",
    "photonpano_run_finished": "runs/scan: done\n",
}
"""The output of the examples of the observation hooks, called with `ARGUMENTS`."""
ARGUMENTS: dict[str, dict[str, Any]] = {
    "photonpano_run_started": {"spec": {"source": {"use": "simulator"}, "run": {"seed": 3}}},
    "photonpano_stage_finished": {"level": 2, "stage": "locate", "seconds": 1.46, "summary": {}},
    "photonpano_run_finished": {"record": {}, "error": None},
}


@pytest.fixture(autouse=True)
def forget_meters() -> Iterator[None]:
    """Forget the kind of component that the example of a kind of run defines."""
    yield
    registry.KINDS.pop("meter", None)


def example_of(hook: str) -> types.ModuleType:
    """Make a plugin of the example in the section of a hook."""
    (code,) = re.findall(r"^```python\n(.*?)^```$", dict(SECTIONS)[hook], re.MULTILINE | re.DOTALL)
    module = types.ModuleType(f"example_of_{hook}")
    exec(compile(code, module.__name__, "exec"), vars(module))
    return module


def test_every_hook_is_tested_here() -> None:
    assert set(HOOKS) == {*KINDS, *OBSERVED}
    own = {kind.hook: kind.name for kind in registry.KINDS.values() if kind.hook in HOOKS}
    assert {hook: kind for hook, (kind, _) in KINDS.items()} == own
    assert set(OBSERVED) == set(OBSERVATION_HOOKS)


def test_page_has_one_section_for_every_hook() -> None:
    assert [name for name, _ in SECTIONS if name != "photonpano_pose_estimators"] == list(HOOKS)


@pytest.mark.parametrize("hook", HOOKS)
def test_docstring_is_short_and_points_to_section(hook: str) -> None:
    docstring = inspect.getdoc(HOOKS[hook]) or ""
    assert f"`{PAGE}#{hook}`" in docstring
    assert len(docstring.splitlines()) <= 5


@pytest.mark.parametrize("hook", KINDS)
def test_component_hook_has_no_arguments_and_complete_example(hook: str) -> None:
    assert not inspect.signature(HOOKS[hook]).parameters
    (contribution,) = contributions_of(example_of(hook))
    assert (contribution.kind, contribution.name) == KINDS[hook]


def test_hook_of_pose_estimators_has_complete_example() -> None:
    (contribution,) = contributions_of(example_of("photonpano_pose_estimators"))
    assert (contribution.kind, contribution.name) == ("pose-estimator", "never-posed")


@pytest.mark.parametrize("hook", OBSERVED)
def test_observation_hook_has_documented_arguments_and_complete_example(hook: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = list(inspect.signature(HOOKS[hook]).parameters)
    table = dict(SECTIONS)[hook].partition("| Argument | |\n")[2].partition("\n\n")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == arguments
    observation = observation_of(example_of(hook))
    assert set(ARGUMENTS[hook]) | {"directory"} == set(arguments)
    getattr(observation, hook)(directory=Path("runs/scan"), **ARGUMENTS[hook])
    assert capsys.readouterr().err == OBSERVED[hook]


def test_run_kind_example_runs_beside_others(tiny_spec: dict[str, Any], tmp_path: Path) -> None:
    def measured(source: Any) -> np.ndarray:
        return np.array([source.counts(FrameSpan(frame, frame + 1)).mean() for frame in range(source.info.n_frames)])

    example = example_of("photonpano_run_kinds")
    meter = example.MeterContribution(
        name="mean", summary="Mean", config=Config, build=lambda *_: types.SimpleNamespace(measure=measured)
    )
    catalog = discover().including(example, meter)
    found = run(parse_spec({**shared(tiny_spec), "meter": "mean"}, output=tmp_path / "run", catalog=catalog))
    assert found.record["brightnesses"]["mean"] == pytest.approx(np.load(tmp_path / "run" / "brightnesses.npy").mean())
    assert found.rows == [("mean", f"{found.record['brightnesses']['mean']:.3f} of the pixels are lit")]
    assert found.record["spec"]["meter"] == {"use": "mean", "with": {}}
    with pytest.raises(SpecError, match="does not apply with `meter`, which finds brightnesses instead of a panorama"):
        parse_spec({**tiny_spec, "meter": "mean"}, output=tmp_path / "other", catalog=catalog)


def shared(spec: dict[str, Any]) -> dict[str, Any]:
    """Return the sections of a spec that hold for every kind of run."""
    return {name: section for name, section in spec.items() if name not in PANORAMA_ONLY}


@pytest.mark.parametrize("section", ["merge", "interpolate"])
def test_stage_example_locates_all_exposures(section: str, tiny_spec: dict[str, Any], tmp_path: Path) -> None:
    hook, name = {"merge": ("photonpano_mergers", "naive-sum"), "interpolate": ("photonpano_interpolators", "nearest")}[section]
    catalog = discover().including(example_of(hook))
    plan = parse_spec(tiny_spec | {section: {"use": name}}, output=tmp_path / "run", catalog=catalog)
    record = run(plan).record
    assert {"stage": section, "use": name, "plugin": f"example_of_{hook}", "version": "unreleased"} in record["plugins"]
    assert record["levels"][0]["located"] == 4


def test_executor_example_has_the_same_results(tiny_spec: dict[str, Any], tmp_path: Path) -> None:
    catalog = discover().including(example_of("photonpano_executors"))
    for name, settings in (("threads", {}), ("one by one", {"executor": "one-by-one"})):
        run(parse_spec(tiny_spec | {"run": settings}, output=tmp_path / name, catalog=catalog))
    for file in ("trajectory.npz", "panorama.tiff"):
        assert (tmp_path / "one by one" / file).read_bytes() == (tmp_path / "threads" / file).read_bytes()


def test_merger_example_masks_invalid_pixels(memory_source: type) -> None:
    frames, valid = np.ones((10, 4, 6)), np.ones((4, 6), bool)
    valid[1, 2] = False
    (contribution,) = contributions_of(example_of("photonpano_mergers"))
    merger = contribution.build(contribution.config(), None)
    exposure = merger.merge(memory_source(frames, valid), Group(FrameSpan(0, 10), 4.5), None, 1.0)
    np.testing.assert_array_equal(np.isnan(exposure.flux), ~valid)
    np.testing.assert_array_equal(exposure.weight, np.where(valid, 10, 0))


def kept(hook: str, kit: type[Conformance]) -> type[Conformance]:
    """Return the tests that the example of a hook keeps what components of its kind promise."""
    (contribution,) = contributions_of(example_of(hook))
    return type(contribution.name, (kit,), {"contribution": contribution, "hook_module": "photonpano_core.hooks"})


TestHalves = kept("photonpano_resamplers", ResamplerConformance)
TestJump = kept("photonpano_refiners", RefinerConformance)
TestNearestPixel = kept("photonpano_renderers", RendererConformance)
TestPgm = kept("photonpano_exporters", ExporterConformance)
