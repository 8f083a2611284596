"""Panoramas as OME-Zarr: what the levels hold, where their pixels are, and how much memory writing takes."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import OutputError
from photonpano.geometry import rescaling, translation
from photonpano.pipeline.rendering import AttributedExporter
from photonpano.testing.images import PANORAMA_SHAPE, panorama

zarr = pytest.importorskip("zarr", reason="OME-Zarr needs photonpano[zarr]")

ome = pytest.importorskip("photonpano_zarr.ome")
MAPS = ("flux", "weight", "std", "saturated")


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut PANORAMA_SHAPE into several bands, files and levels."""
    for name, value in {"_CHUNK": 8, "_SHARD_COLUMNS": 16, "_READ_ROWS": 3}.items():
        monkeypatch.setattr(ome, name, value)


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("in_colour", [False, True])
def test_first_level_holds_the_panorama(tmp_path: Path, in_colour: bool) -> None:
    stored = panorama(in_colour)
    ome.OmeZarrExporter().export(stored, tmp_path / "a.ome.zarr")
    group = zarr.open_group(tmp_path / "a.ome.zarr", mode="r")
    rows = stored.rows(0, PANORAMA_SHAPE[0])
    expected = np.stack([getattr(rows, name) for name in MAPS]).reshape(4, *PANORAMA_SHAPE, -1)
    np.testing.assert_array_equal(group["0"][:], np.moveaxis(expected, -1, 1).reshape(-1, *PANORAMA_SHAPE))
    assert [group[str(level)].shape[1:] for level in range(4)] == [(37, 53), (19, 27), (10, 14), (5, 7)]
    channels = group.attrs["ome"]["omero"]["channels"]
    ends = [".R", ".G", ".B"] if in_colour else [""]
    assert [channel["label"] for channel in channels] == [f"{name}{end}" for name in MAPS for end in ends]
    assert [channel["active"] for channel in channels] == [channel["label"].startswith("flux") for channel in channels]
    assert channels[0]["window"] == {"min": 0, "max": pytest.approx(np.nanmax(rows.flux)), "start": 0, "end": stored.white_flux}


@pytest.mark.usefixtures("small_chunks")
def test_last_level_is_that_of_all_photons(tmp_path: Path) -> None:
    """Merging level by level and file by file keeps the sums of frames, of photons and of their variances."""
    stored = panorama()
    stored.weight[20:, 30:] /= 7
    ome.OmeZarrExporter().export(stored, tmp_path / "a.ome.zarr")
    maps = zarr.open_group(tmp_path / "a.ome.zarr", mode="r")["3"][:]
    rows = stored.rows(0, PANORAMA_SHAPE[0])
    frames, (flux, weight, std, saturated) = rows.weight.sum(dtype=float), maps.astype(float)
    assert 64 * weight.sum() == pytest.approx(frames, rel=1e-5)
    assert 64 * np.nansum(weight * flux) == pytest.approx(np.nansum(rows.weight.astype(float) * rows.flux), rel=1e-5)
    variance = np.nansum((rows.weight.astype(float) * rows.std) ** 2)
    assert 64**2 * np.nansum((weight * std) ** 2) == pytest.approx(variance, rel=1e-5)
    assert saturated[-1].tolist() == [1.0] * 7
    assert not saturated[:-1].any()


def test_std_of_merged_pixels_is_that_of_their_flux() -> None:
    """Noisy flux of pixels that were seen in 10, 20, 30 and 40 frames; unseen pixels do not count."""
    rng, n = np.random.default_rng(0), 300
    weight = np.tile(np.float32([[10, 20], [30, 40]]), (n, n))
    weight[:2, :2] = [[0, 20], [0, 0]]
    weight[:2, 2:4] = 0
    flux = np.where(weight > 0, rng.poisson(0.5 * weight) / np.maximum(weight, 1), np.nan)
    std = np.sqrt(0.5 / np.where(weight > 0, weight, np.nan))
    halved = ome.halved(np.stack([flux, weight, std, weight == 10]).astype(np.float32))
    assert halved[0, 0, 0] == pytest.approx(flux[0, 1])
    assert halved[1:, 0, 0].tolist() == pytest.approx([5, std[0, 1], 0])
    np.testing.assert_array_equal(halved[:, 0, 1], [np.nan, 0, np.nan, 0])
    assert (halved[1, 1:], halved[3, 1:]) == (pytest.approx(25), pytest.approx(1))
    assert halved[2, 1:] == pytest.approx(np.sqrt(0.5 / 100))
    spread = (halved[0, 1:].astype(float) - 0.5) / halved[2, 1:]
    assert np.mean(spread**2) == pytest.approx(1, abs=5 * np.sqrt(2 / spread.size))


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize(("projection", "per_unit"), [("planar", 1.0), ("spherical", np.pi / 180)])
def test_coordinates_are_those_of_the_reference_frame(tmp_path: Path, projection: str, per_unit: float) -> None:
    """The pixel (i, j) of a level covers pixels of the panorama whose mean is at its coordinate."""
    canvas = translation(20, 4) @ rescaling(2.0)
    ome.OmeZarrExporter().export(replace(panorama(), canvas=canvas, projection=projection), tmp_path / "a.ome.zarr")
    attributes = zarr.open_group(tmp_path / "a.ome.zarr", mode="r").attrs
    (image,) = attributes["ome"]["multiscales"]
    assert [axis["name"] for axis in image["axes"]] == ["c", "y", "x"]
    for level, dataset in enumerate(image["datasets"]):
        scale, shift = dataset["coordinateTransformations"]
        at = np.array(scale["scale"]) * [2, 3, 5] + shift["translation"]
        covered = np.arange(2**level)
        x, y = 5 * 2**level + covered.mean(), 3 * 2**level + covered.mean()
        assert canvas @ [at[2] * per_unit, at[1] * per_unit, 1] == pytest.approx([x, y, 1])
    assert attributes["photonpano"]["channels"]["flux"] == "photons per pixel per frame"
    assert attributes["photonpano"]["unit"] == ("degree" if projection == "spherical" else "pixel of the reference frame")


def test_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("zarr.storage._local._put", full)
    with pytest.raises(OutputError) as caught:
        AttributedExporter(ome.OmeZarrExporter(), "exporter 'ome-zarr'", ".ome.zarr").export(panorama(), tmp_path)
    assert str(caught.value) == (
        "panorama.ome.zarr could not be written (No space left on device); what was in the run folder before is unchanged. "
        "Make room, or choose another folder with --output"
    )
