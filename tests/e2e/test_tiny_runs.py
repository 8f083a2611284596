"""Whole runs of a tiny capture: what they write, repeat, keep and report, with exporters that work and that do not."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

import photonpano
from photonpano import Config, ExporterContribution, PluginError, discover
from photonpano.merging.panorama import BYTES_PER_PIXEL
from photonpano.pipeline.run import RunResult
from photonpano.record.contents import changed_files
from photonpano.specs import parse_spec


@pytest.fixture
def run(tiny_spec: dict[str, Any], tmp_path: Path) -> Callable[..., RunResult]:
    """Run the tiny spec into the folder `run`, with overrides, or with other sections."""

    def run(*overrides: str, catalog: Any = None, resume: bool = False, **sections: Any) -> RunResult:
        plan = parse_spec(tiny_spec | sections, overrides=overrides, output=tmp_path / "run", catalog=catalog)
        return photonpano.run(plan, resume=resume)

    return run


def test_panorama_larger_than_memory_is_written_in_parts(run: Callable[..., RunResult], tmp_path: Path) -> None:
    record = run("render.scale=14", "run.memory=64 MiB").record["panorama"]
    flux, coverage = (tifffile.imread(tmp_path / "run" / name) for name in ("panorama.tiff", "coverage.tiff"))
    picture = cv2.imread(str(tmp_path / "run" / "panorama.png"), cv2.IMREAD_UNCHANGED)
    factor = record["picture_reduction"]
    assert flux.size * BYTES_PER_PIXEL > 64 * 1024**2
    assert flux.shape == coverage.shape == (record["height"], record["width"])
    assert picture.shape == tuple(-(-side // factor) for side in flux.shape)
    np.testing.assert_array_equal(np.isnan(flux), coverage == 0)
    assert record["coverage_share"] == pytest.approx((coverage > 0).mean())
    # The picture shows the same: bright where the flux is.
    whole = np.s_[: flux.shape[0] // factor * factor, : flux.shape[1] // factor * factor]
    blocks = np.nan_to_num(flux[whole]).reshape(flux.shape[0] // factor, factor, -1, factor).mean(axis=(1, 3))
    shown = picture[: blocks.shape[0], : blocks.shape[1]]
    assert np.corrcoef(np.sqrt(blocks).ravel(), shown.ravel())[0, 1] > 0.98
    assert f"<code>panorama.png</code> one pixel for {factor}" in (tmp_path / "run" / "report.html").read_text()


def test_bytes_of_results_depend_neither_on_threads_nor_on_where_the_spec_comes_from(
    tiny_spec: dict[str, Any], outcome_of: Callable
) -> None:
    """Levels of four and nine groups: the order in which threads finish must not matter. The last spec is a recorded one."""
    specs = [tiny_spec | {"levels": 2, "run": {"threads": threads, "seed": 3}} for threads in (1, 3)]
    first, second = (outcome_of(parse_spec(spec)) for spec in specs)
    again = outcome_of(parse_spec(json.loads(json.dumps(first.record["spec"]))))
    hashes = [{name: content["sha256"] for name, content in each.record["files"].items()} for each in (first, second, again)]
    assert {"trajectory.npz", "panorama.tiff", "coverage.tiff", "panorama.png"} <= set(hashes[0])
    assert hashes[1:] == hashes[:-1]


@pytest.mark.parametrize(
    "changes", [["motion.model=auto"], ["motion.model=rotation"], ["motion.model=rotation", "light=changing"]]
)
def test_capture_of_one_exposure_has_a_panorama_and_no_camera(run: Callable[..., RunResult], changes: list[str]) -> None:
    record = run("resample.with.group_size=160", *changes).record
    assert [(level["groups"], level["camera"]) for level in record["levels"]] == [(1, None)]
    assert record["warnings"][0].startswith("only one exposure was located")


@pytest.mark.parametrize("wrong", ["frame rate", "backend"])
def test_run_without_report_keeps_its_results(
    run: Callable[..., RunResult], tmp_path: Path, wrong: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A figure over a time axis without end, and a matplotlib that cannot be used."""
    if wrong == "backend":
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    record = run(*(["source.with.frame_rate_hz=1e-320"] if wrong == "frame rate" else [])).record
    (warning,) = [each for each in record["warnings"] if "report" in each]
    assert warning.startswith("the report could not be drawn (")
    assert warning.endswith("); all other files of the run are written")
    assert json.loads((tmp_path / "run" / "run.json").read_text()) == json.loads(json.dumps(record))
    maps = {"panorama.tiff", "panorama-std.tiff", "coverage.tiff", "first-frame.tiff", "last-frame.tiff"}
    assert set(record["files"]) == {"trajectory.npz", "panorama.png", *maps}
    assert photonpano.verify(tmp_path / "run").problems == ()


@pytest.mark.usefixtures("without_report")
def test_run_writes_formats_and_records_their_hashes(run: Callable[..., RunResult], tmp_path: Path) -> None:
    folder, render = tmp_path / "run", {"extent": "reference", "tone": "local", "exposure_stops": 0.5}
    record = run(output={"formats": ["hdr", "ome-zarr"]}, render=render).record
    flux = tifffile.imread(folder / "panorama.tiff")
    assert flux.shape == (record["source"]["height"], record["source"]["width"])
    hdr = cv2.imread(str(folder / "panorama.hdr"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(hdr[..., 0], np.nan_to_num(flux), rtol=0.005)
    assert "panorama.hdr" in json.loads((folder / "run.json").read_text())["files"]
    assert "panorama.ome.zarr/0/c/0/0/0" in record["files"]
    assert changed_files(folder) == []
    assert {"stage": "output", "use": "ome-zarr"}.items() <= record["plugins"][-1].items()
    (folder / "panorama.ome.zarr/0/c/0/0/0").write_bytes(b"damaged")
    assert photonpano.verify(folder).problems != ()
    run()
    assert not (folder / "panorama.hdr").exists()
    assert not (folder / "panorama.ome.zarr").exists()


class Keys(Config):
    """No keys."""


class Odd:
    """Does something else than writing its file."""

    def __init__(self, what: str) -> None:
        self.what = what

    def export(self, panorama: Any, path: Path) -> None:
        match self.what:
            case "two":
                path.write_text("a")
                path.with_suffix(".txt").write_text("b")
            case "empty":
                path.touch()
            case "fails":
                raise LookupError("no such colour")


@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("two", "broke its contract at panorama.odd: expected panorama.odd alone, got panorama.txt as well"),
        ("empty", "broke its contract at panorama.odd: expected a file or folder panorama.odd with content, got none"),
        ("fails", "failed at panorama.odd: LookupError: no such colour"),
        ("nothing", "broke its contract at panorama.odd: expected a file or folder panorama.odd with content, got none"),
    ],
)
def test_exporter_that_misbehaves_is_named(run: Callable[..., RunResult], tmp_path: Path, what: str, message: str) -> None:
    odd = ExporterContribution(name="odd", summary="Toy", config=Keys, suffix=".odd", build=lambda *_: Odd(what))
    with pytest.raises(PluginError) as caught:
        run(output={"formats": "odd"}, catalog=discover().including(odd))
    assert str(caught.value) == f"exporter 'odd' of {__name__} unreleased {message}"
    assert not (tmp_path / "run").exists()
