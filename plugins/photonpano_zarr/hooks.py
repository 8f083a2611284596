"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from photonpano import (
    Exporter,
    ExporterContribution,
    Location,
    Recognised,
    Requirement,
    SourceContribution,
    StageContext,
    Url,
    hookimpl,
)
from photonpano.reading import as_written, objections
from photonpano_zarr.configs import OmeZarrConfig, ZarrConfig
from photonpano_zarr.source import opened, require_layout, write


def _check(config: ZarrConfig) -> Sequence[str]:
    return objections(require_layout, config)


def _recognise(path: Location) -> Recognised | None:
    """Take arrays that open without further keys."""
    if path.suffix.lower() != ".zarr" and (isinstance(path, Url) or not (path / "zarr.json").is_file()):
        return None
    if not _check(ZarrConfig(path=path)):
        return Recognised({"path": as_written(path)}, "an array of packed frames of zarr version 3")
    if not _check(ZarrConfig(path=path, holds="bits")):
        return Recognised({"path": as_written(path), "holds": "bits"}, "an array of bits of zarr version 3")
    return None


def _exporter(_config: OmeZarrConfig, _context: StageContext) -> Exporter:
    from photonpano_zarr.ome import OmeZarrExporter

    return OmeZarrExporter()


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer the source of zarr arrays."""
    yield SourceContribution(
        name="zarr",
        summary="Binary frames in a zarr array, packed or not, in a folder or an object store",
        config=ZarrConfig,
        build=lambda config, _: opened(config),
        check=_check,
        recognise=_recognise,
        recognises_urls=True,
        suffixes=(".zarr",),
        write=write,
    )


@hookimpl
def photonpano_exporters() -> Iterator[ExporterContribution]:
    """Offer a file for panoramas that exceed the memory of viewers."""
    yield ExporterContribution(
        name="ome-zarr",
        summary="OME-Zarr: flux, weight, standard deviation and saturated pixels in tiles of several scales, for viewers",
        config=OmeZarrConfig,
        suffix=".ome.zarr",
        requires=(Requirement("zarr", "photonpano[zarr]"),),
        build=_exporter,
    )
