"""Checks of exporters, with small panoramas."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from photonpano.merging.canvas_noise import CanvasNoise
from photonpano.photometry import BinaryResponse, flux_std
from photonpano.pipeline.rendering import AttributedExporter, StoredPanorama
from photonpano.plugins.contributions import ExporterContribution
from photonpano.record.contents import contents_of
from photonpano.record.schema import FileContent
from photonpano.testing.conformance import StageConformance, passing

SHAPE = (37, 53)


def panorama(in_colour: bool = False, nothing_seen: bool = False) -> StoredPanorama:
    """Return flux over 120 dB, with unseen and saturated pixels."""
    shape = (*SHAPE, 3) if in_colour else SHAPE
    flux = (10 ** np.random.default_rng(0).uniform(-5, 1, shape)).astype(np.float32)
    weight = np.full(shape, 100_000, np.float32)
    flux[:5, :7], weight[:5, :7] = np.nan, 0
    flux[-1] = np.log(200_001)
    if nothing_seen:
        flux[:], weight[:] = np.nan, 0
    response = BinaryResponse()
    return StoredPanorama(flux, weight, flux_std(flux, weight, response), np.eye(3), 1.0, CanvasNoise(response))


class ExporterConformance(StageConformance):
    """Checks of an exporter."""

    kind: ClassVar[str] = "exporter"

    contribution: ExporterContribution

    def exported(self, of: StoredPanorama, folder: Path) -> Mapping[str, FileContent]:
        """Write a panorama as a run does, and return the hashes of its files."""
        self.require_libraries()
        folder.mkdir()
        with passing("what export() does"):
            AttributedExporter(self.built(), f"exporter {self.contribution.name!r}", self.contribution.suffix).export(
                of, folder
            )
        return contents_of(folder)

    @pytest.mark.parametrize("in_colour", [False, True])
    def test_export_writes_one_file_or_folder_with_content(self, tmp_path: Path, in_colour: bool) -> None:
        """Panoramas are grey, or have red, green and blue; some pixels were not seen."""
        self.exported(panorama(in_colour), tmp_path / "run")

    def test_export_accepts_panorama_of_which_nothing_is_known(self, tmp_path: Path) -> None:
        """A part of the canvas may not have been seen."""
        self.exported(panorama(nothing_seen=True), tmp_path / "run")

    def test_export_is_deterministic(self, tmp_path: Path) -> None:
        """The same panorama gives the same bytes, so that a run can be repeated."""
        first, second = (self.exported(panorama(), tmp_path / name) for name in ("first", "second"))
        assert first == second, "export() writes other bytes for the same panorama; leave out times and names of files"
