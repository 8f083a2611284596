"""The list of corrections: files, overrides, and what is recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import SpecError
from photonpano.registry import Catalog
from photonpano.specs import load_spec, parse_spec


def spec(*corrections: Any) -> dict[str, Any]:
    return {"version": 1, "source": {"use": "simulator"}, "corrections": list(corrections)}


def test_correction_paths_are_relative_to_spec(catalog: Catalog, tmp_path: Path) -> None:
    np.save(tmp_path / "bad.npy", np.zeros((2, 2), bool))
    plan = parse_spec(spec({"mask": {"file": "bad.npy"}}), directory=tmp_path, catalog=catalog)
    assert plan.document["corrections"] == [{"mask": {"file": str(tmp_path / "bad.npy")}}]
    assert parse_spec(plan.document, catalog=catalog).corrections == plan.corrections


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
