"""Write the panorama in further formats: exporters read it from the files of the run, and what they write is checked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from photonpano.contracts.attribution import attributing
from photonpano.contracts.results import FILES
from photonpano.errors import OutputError
from photonpano.merging.canvas_noise import CanvasNoise
from photonpano.merging.panorama import RenderedPanorama
from photonpano.protocols import Exporter
from photonpano.values import Homography, PanoramaRows


@dataclass(frozen=True, slots=True, eq=False)
class StoredPanorama:
    """The files of a rendered panorama: a `FinishedPanorama`.

    Attributes:
        flux: (H, W) or (H, W, 3) float32, on disk.
        weight: the same shape, on disk.
        canvas: (3, 3), pixels of the reference plane to pixels of the panorama.
        white_flux: flux that is white in the picture.
    """

    flux: NDArray[np.float32]
    weight: NDArray[np.float32]
    canvas: Homography
    white_flux: float
    noise: CanvasNoise

    @classmethod
    def of(cls, folder: Path, panorama: RenderedPanorama) -> StoredPanorama:
        """Open panorama.tiff and coverage.tiff in a folder."""
        flux, weight = (tifffile.memmap(folder / name, mode="r") for name in ("panorama.tiff", "coverage.tiff"))
        assert panorama.noise is not None
        return cls(flux, weight, panorama.canvas.transform, panorama.white_flux, panorama.noise)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.flux.shape[0], self.flux.shape[1]

    @property
    def in_colour(self) -> bool:
        """Whether pixels have red, green and blue."""
        return self.flux.ndim == 3

    def rows(self, start: int, stop: int) -> PanoramaRows:
        """Return some rows, as arrays of their own."""
        flux, weight = (np.array(image[start:stop], np.float32) for image in (self.flux, self.weight))
        return PanoramaRows(flux, weight, self.noise.std(flux, weight, top=start), self.noise.saturated(flux, weight))


@dataclass(frozen=True, slots=True)
class AttributedExporter:
    """An exporter whose errors name its `origin`, such as "exporter 'exr' of photonpano 0.1.0", and whose file is checked."""

    component: Exporter
    origin: str
    suffix: str

    def export(self, panorama: StoredPanorama, folder: Path) -> None:
        """Write the panorama into a folder.

        Raises:
            OutputError: the file cannot be written, as on a full disk.
            PluginError: the exporter failed, or broke its contract.
        """
        path = folder / f"panorama{self.suffix}"
        before = {each.name for each in folder.iterdir()}
        with attributing(self.origin, path.name):
            try:
                self.component.export(panorama, path)
            except OSError as error:
                reason = f"{path.name} could not be written ({error.strerror or error})"
                raise OutputError(f"{reason}; what was in the run folder before is unchanged") from error
            FILES.require({each.name for each in folder.iterdir()} - before, path)


def export_all(exporters: Iterable[AttributedExporter], folder: Path, panorama: RenderedPanorama) -> None:
    """Write the panorama with all exporters, one after the other."""
    for exporter in exporters:
        exporter.export(StoredPanorama.of(folder, panorama), folder)
