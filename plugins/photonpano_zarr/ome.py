"""Write the panorama as a multiscale image of OME-Zarr 0.5, with its maps as channels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from photonpano import FinishedPanorama, FluxImage

_MAPS = ("flux", "weight", "std", "saturated")
_FLUX = "photons per pixel per frame"
_UNITS = {"flux": _FLUX, "weight": "frames", "std": _FLUX, "saturated": "1 for a pixel that was lit in every frame"}
_CHUNK = 256  # sides of a chunk, in px, which viewers read one by one; in colour, half as high
_SHARD_COLUMNS = 16 * _CHUNK  # columns of the chunks that share a file; a file holds one row of chunks, of all channels
_FILLED = 1e-6  # frames as which known flux without frames counts
_READ_ROWS = 32  # rows that are read at once: their noise takes several times their memory


class OmeZarrExporter:
    """Writes the panorama, and levels that are each half as large as the one before."""

    def export(self, panorama: FinishedPanorama, path: Path) -> None:
        """Write the folder: see `Exporter`. One row of chunks is held in memory; the metadata come last."""
        colours = ["R", "G", "B"] if panorama.in_colour else [""]
        n_channels, (height, width) = len(_MAPS) * len(colours), panorama.shape
        level = _array(path / "0", n_channels, height, width)
        highest = np.zeros(n_channels)
        _, rows, columns = level.shards
        for top in range(0, height, rows):
            band = _band(panorama, n_channels, top, min(top + rows, height))
            highest = np.fmax(highest, np.fmax.reduce(band, axis=(1, 2)))
            for left in range(0, width, columns):
                level[:, top : top + rows, left : left + columns] = band[:, :, left : left + columns]
        del band
        n_levels = 1
        while max(level.shape[1:]) > _CHUNK:
            level = _next_level(level, path / str(n_levels))
            n_levels += 1
        ome = {
            "version": "0.5",
            "multiscales": [_multiscale(panorama, n_levels)],
            "omero": {"channels": _channels(panorama, colours, highest)},
        }
        # Neuroglancer opens no image with a unit that it does not know, and degrees are one. So axes have no units.
        unit = "pixel of the reference frame" if panorama.projection == "planar" else "degree"
        about = {"projection": panorama.projection, "unit": unit, "channels": _UNITS, "capture": panorama.capture}
        zarr.create_group(path, attributes={"ome": ome, "photonpano": about})


def halved(maps: FluxImage) -> FluxImage:
    """Merge squares of 2 x 2 pixels of the maps (channels, h, w), flux, weight, std and saturated: (channels, h / 2, w / 2).

    Flux is the mean, weighted by the frames of each pixel, as if their photons were counted in one pixel. Weight is the mean
    number of frames. std is that of the weighted mean of pixels whose noise is independent. A pixel is saturated if one of the
    four is. Beyond the border, nothing was seen.
    """
    _, height, width = maps.shape
    padded = np.pad(maps, ((0, 0), (0, height % 2), (0, width % 2)), constant_values=np.nan)
    flux, weight, std, saturated = np.split(np.nan_to_num(padded, posinf=np.inf), len(_MAPS))
    # A colour that was filled from the others is known without frames of its own.
    share = np.where(np.isfinite(padded[: len(flux)]), np.maximum(weight, np.float32(_FILLED)), np.float32(0))
    total = _summed(share)
    with np.errstate(invalid="ignore"):  # NaN where nothing was seen
        means = _summed(share * flux) / total, _summed(weight) / 4, np.sqrt(_summed((share * std) ** 2)) / total
    return np.concatenate([*means, np.sign(_summed(saturated))]).astype(np.float32, copy=False)


def _summed(image: FluxImage) -> FluxImage:
    return np.asarray(image[:, ::2, ::2] + image[:, 1::2, ::2] + image[:, ::2, 1::2] + image[:, 1::2, 1::2], np.float32)


def _band(panorama: FinishedPanorama, n_channels: int, top: int, bottom: int) -> FluxImage:
    """Return the maps of some rows: (channels, h, W), map by map, and in each colour by colour."""
    band = np.empty((n_channels, bottom - top, panorama.shape[1]), np.float32)
    for start in range(top, bottom, _READ_ROWS):
        stop = min(start + _READ_ROWS, bottom)
        rows = panorama.rows(start, stop)
        images = np.stack([getattr(rows, name) for name in _MAPS]).reshape(len(_MAPS), stop - start, panorama.shape[1], -1)
        band[:, start - top : stop - top] = np.moveaxis(images, -1, 1).reshape(n_channels, stop - start, -1)
    return band


def _next_level(level: Any, path: Path) -> Any:
    """Write the level after another, and return its array."""
    n_channels, height, width = level.shape
    smaller = _array(path, n_channels, -(-height // 2), -(-width // 2))
    _, rows, columns = smaller.shards
    for top in range(0, height, 2 * rows):
        for left in range(0, width, 2 * columns):
            part = halved(level[:, top : top + 2 * rows, left : left + 2 * columns])
            y, x = top // 2, left // 2
            smaller[:, y : y + part.shape[1], x : x + part.shape[2]] = part
    return smaller


def _array(path: Path, n_channels: int, height: int, width: int) -> Any:
    """Make the array of a level; chunks of which nothing is written are NaN."""
    rows = _CHUNK if n_channels == len(_MAPS) else _CHUNK // 2  # colours take three times the memory
    return zarr.create_array(
        path,
        shape=(n_channels, height, width),
        chunks=(1, rows, _CHUNK),
        shards=(n_channels, rows, min(_SHARD_COLUMNS, -(-width // _CHUNK) * _CHUNK)),
        dtype="float32",
        fill_value=np.nan,
        dimension_names=("c", "y", "x"),
    )


def _multiscale(panorama: FinishedPanorama, n_levels: int) -> dict[str, Any]:
    """Describe the levels: their pixels in the reference plane, or in degrees."""
    per_unit = 1.0 if panorama.projection == "planar" else np.pi / 180
    factor = panorama.canvas[0, 0] * per_unit  # pixels of the panorama per unit
    datasets = []
    for number in range(n_levels):
        size = 2**number
        y, x = ((size - 1) / 2 - panorama.canvas[axis, 2] for axis in (1, 0))  # centre of the first pixel, in the panorama
        scale, translation = [1.0, size / factor, size / factor], [0.0, y / factor, x / factor]
        transforms = [{"type": "scale", "scale": scale}, {"type": "translation", "translation": translation}]
        datasets.append({"path": str(number), "coordinateTransformations": transforms})
    axes = [{"name": "c", "type": "channel"}, {"name": "y", "type": "space"}, {"name": "x", "type": "space"}]
    return {"name": "panorama", "type": "mean", "axes": axes, "datasets": datasets}


def _channels(panorama: FinishedPanorama, colours: list[str], highest: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Describe how viewers show the channels: at first only the flux, up to white."""
    white, shown = panorama.white_flux, {"R": "FF0000", "G": "00FF00", "B": "0000FF", "": "FFFFFF"}
    channels = []
    for name, colour, high in zip(np.repeat(_MAPS, len(colours)), colours * len(_MAPS), highest.tolist(), strict=True):
        end = {"flux": white, "weight": high or 1.0, "std": white / 10, "saturated": 1.0}[name]
        window = {"min": 0.0, "max": max(high, end), "start": 0.0, "end": end}
        label = f"{name}.{colour}" if colour else str(name)
        channels.append({"label": label, "color": shown[colour], "active": name == "flux", "window": window})
    return channels
