"""Runs that write further files of the panorama, with exporters that work and that do not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import Config, ExporterContribution, PluginError, discover, run
from photonpano.record.contents import changed_files
from photonpano.specs import parse_spec

pytestmark = pytest.mark.usefixtures("without_report")


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


def odd(what: str) -> ExporterContribution:
    return ExporterContribution(name="odd", summary="Toy", config=Keys, suffix=".odd", build=lambda *_: Odd(what))


def test_run_writes_formats_and_records_their_hashes(small_spec: dict[str, Any], tmp_path: Path) -> None:
    output = {"formats": ["hdr"]}
    extent = {"extent": "reference", "tone": "local", "exposure_stops": 0.5}
    plan = parse_spec(small_spec | {"output": output, "levels": 1, "render": extent}, output=tmp_path / "run")
    record = run(plan).record
    flux = tifffile.imread(tmp_path / "run" / "panorama.tiff")
    assert flux.shape == (record["source"]["height"], record["source"]["width"])
    hdr = cv2.imread(str(tmp_path / "run" / "panorama.hdr"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(hdr[..., 0], np.nan_to_num(flux), rtol=0.005)
    assert "panorama.hdr" in json.loads((tmp_path / "run" / "run.json").read_text())["files"]
    assert changed_files(tmp_path / "run") == []
    assert {"stage": "output", "use": "hdr"}.items() <= record["plugins"][-1].items()
    run(parse_spec(small_spec | {"levels": 1}, output=tmp_path / "run"))
    assert not (tmp_path / "run" / "panorama.hdr").exists()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("two", "broke its contract at panorama.odd: expected the one file panorama.odd, got panorama.txt as well"),
        ("empty", "broke its contract at panorama.odd: expected a file panorama.odd with content, got none"),
        ("fails", "failed at panorama.odd: LookupError: no such colour"),
        ("nothing", "broke its contract at panorama.odd: expected a file panorama.odd with content, got none"),
    ],
)
def test_exporter_that_misbehaves_is_named(small_spec: dict[str, Any], tmp_path: Path, what: str, message: str) -> None:
    catalog = discover().including(odd(what))
    spec = small_spec | {"output": {"formats": "odd"}, "levels": 1}
    with pytest.raises(PluginError) as caught:
        run(parse_spec(spec, output=tmp_path / "run", catalog=catalog))
    assert str(caught.value) == f"exporter 'odd' of {__name__} unreleased {message}"
    assert not (tmp_path / "run").exists()
