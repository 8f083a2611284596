"""Source `events`: lists of single photons, with their frame or time and their pixel, of timing sensors and telescopes."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photonpano import Config, FrameSpan, InputError, Recognised, SourceContribution, SpecPath
from photonpano.reading import BinarySource, FrameLayout, as_written, library, objections, read_start, reading, require_readable

# Columns of the frame, and of the time, by their names in lower case; the first that is there.
_FRAMES, _TIMES = ("frame", "frame_number", "expno"), ("time", "timestamp", "t", "toa")
# Columns of the pixel, the likeliest first: in lists of telescopes, x and y lie on the sky.
_PLACES = (("detx", "dety"), ("rawx", "rawy"), ("chipx", "chipy"), ("x", "y"), ("col", "row"), ("column", "row"))
_SKY = ("x", "y")
_SUFFIXES = (".npz", ".csv", ".fits", ".fit", ".evt", ".fits.gz", ".evt.gz")
_LEAST_SHARE = 1e-3  # of frames that hold a photon: fewer, and times were taken for the numbers of frames
_MOST_PX = 65535  # rows or columns
_MOST_FRAMES = 32  # frames unpacked at once
_FEWEST = 3  # columns of a list
_NAME_THEM = "write columns: {when: ..., x: ..., y: ...}"
_DAMAGED = "cannot be read as a list of photons: it is damaged or something else"


class ColumnsConfig(Config):
    """The names of the columns of a list, or their numbers from 0 where they have no names."""

    when: str = Field(description="the frame or the time of a photon")
    x: str = Field(description="the column of the sensor, from left to right")
    y: str = Field(description="the row of the sensor, downwards")
    chip: str | None = Field(None, description="the chip of a mosaic, whose places are `chips`")
    sky: tuple[str, str] | None = Field(
        None, description="where the photon comes from, as the instrument knows it, x and y: the truth of `photonpano evaluate`"
    )


class EventsConfig(Config):
    """A list of photons in one file, ordered by frame or time."""

    path: SpecPath = Field(description="a .npy, .npz or .csv file, or a FITS table (needs photonpano[fits])")
    columns: ColumnsConfig | None = Field(None, description="its columns; by default, by their usual names or their order")
    frame_duration: float | None = Field(
        None,
        gt=0,
        description="duration of a frame, in the unit of the times; without it, photons have the number of their frame",
    )
    start: float | None = Field(
        None, description="number of the first frame, or the time at which it begins; that of the first photon by default"
    )
    n_frames: int | None = Field(None, ge=1, description="number of frames; up to the last photon by default")
    bin: int = Field(1, ge=1, description="pixels of the list along each side of a pixel of a frame")
    origin: tuple[int, int] | None = Field(
        None, description="x and y of the first pixel; by default the least of all photons, or 0 if frame_shape is given"
    )
    frame_shape: tuple[int, int] | None = Field(
        None, description="rows and columns of a frame, in px; by default as many as the photons need"
    )
    chips: dict[int, tuple[int, int]] | None = Field(
        None, description="x and y by which the pixels of each chip of a mosaic are moved, by the number of the chip"
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


class _Photons(NamedTuple):
    """The photons that lie in the frames, in order."""

    frames: NDArray[np.int64]  # (N,) number of the frame of each
    places: NDArray[np.float64]  # (N, 2) x and y, in px
    shape: tuple[int, int]  # (height, width) of a frame
    n_frames: int
    sky: NDArray[np.float64] | None  # (N, 2) where they come from, if that is known


class EventsSource(BinarySource):
    """Binary frames of a list of photons: a pixel is lit if the list has a photon of it. Only the photons are kept."""

    def __init__(self, photons: _Photons, frame_rate_hz: float | None) -> None:
        height, width = photons.shape
        super().__init__(photons.n_frames, FrameLayout(photons.shape, (height, -(-width // 8))), frame_rate_hz)
        self._photons = photons
        self._lit = np.floor(photons.places).astype(np.int64) @ [1, width]
        self._ends = np.searchsorted(photons.frames, np.arange(photons.n_frames + 1))

    def counts(self, span: FrameSpan) -> NDArray[np.uint32]:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        lit = self._places(span) % (self.info.height * self.info.width)
        counts = np.bincount(lit, minlength=self.info.height * self.info.width)
        return counts.astype(np.uint32).reshape(self.info.frame_shape)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, a few at a time: see `BinarySource`."""
        for start in range(span.start, span.stop, _MOST_FRAMES):
            part = FrameSpan(start, min(start + _MOST_FRAMES, span.stop))
            frames = np.zeros((len(part), *self.info.frame_shape), np.uint8)
            frames.reshape(-1)[self._places(part)] = 1
            yield slice(start - span.start, part.stop - span.start), np.packbits(frames, axis=-1)

    def _places(self, span: FrameSpan) -> NDArray[np.int64]:
        """Return the indices of the lit pixels of a span in (n, H, W), each once."""
        photons = slice(self._ends[span.start], self._ends[span.stop])
        within = self._photons.frames[photons] - span.start
        return np.unique(within * (self.info.height * self.info.width) + self._lit[photons])


class SkyEventsSource(EventsSource):
    """A list that knows where its photons come from, as a telescope does: `photonpano.KnowsTruth`."""

    def truth(self) -> Mapping[str, NDArray[np.generic]]:
        """Return the motion, by least squares: the sky is an affine map of the pixel, which shifts from frame to frame."""
        frames, places, shape, n_frames, sky = self._photons
        assert sky is not None
        number = np.bincount(frames, minlength=n_frames)[:, None]
        seen = np.flatnonzero(number)

        def of_frames(values: NDArray[np.float64]) -> NDArray[np.float64]:
            sums = np.stack([np.bincount(frames, each, n_frames) for each in values.T], axis=1)
            return np.asarray(sums / np.maximum(number, 1))

        here, there = of_frames(places), of_frames(sky)
        to_sky = np.linalg.lstsq(places - here[frames], sky - there[frames])[0]
        shifts = np.linalg.solve(to_sky.T, there.T).T - here
        shifts -= shifts[seen[0]]
        motion = np.tile(np.eye(3), (n_frames, 1, 1))
        motion[:, :2, 2] = np.stack([np.interp(np.arange(n_frames), seen, each[seen]) for each in shifts.T], axis=1)
        return {"homographies": motion, "frame_shape": np.array(shape)}


def _placed(config: EventsConfig) -> _Photons:
    """Read the photons of a list."""
    path, table = config.path, _table(config.path)
    names = config.columns or _named(path, table.names, timed=config.frame_duration is not None)
    used = [names.when, names.x, names.y, *([names.chip] if names.chip else []), *(names.sky or ())]
    if missing := [name for name in used if name not in table.names]:
        raise InputError(f"{path} has no column {missing[0]!r}; its columns are {', '.join(table.names)}")
    with reading(path, _DAMAGED):
        values = {name: np.asarray(column, float) for name, column in table.read(used).items()}
    lengths = [column.shape for column in values.values()]
    if len(set(lengths)) > 1 or len(lengths[0]) != 1:
        raise InputError(f"{path} has arrays of the shapes {', '.join(map(str, lengths))}; all columns have one length")
    if not lengths[0][0]:
        raise InputError(f"{path} holds no photon")
    for name, each in values.items():
        if (wrong := np.flatnonzero(~np.isfinite(each))).size:
            raise InputError(f"{path} has no number in column {name!r} of row {wrong[0]}, from 0; leave such rows out")
    frames = _numbered(config, names.when, values[names.when])
    places = np.stack([values[names.x], values[names.y]], axis=1)
    if names.chip:
        places += _of_chips(config, values[names.chip])
    least = (0, 0) if config.frame_shape else tuple(np.floor(places.min(axis=0)).astype(int).tolist())
    places = (places - np.array(config.origin or least)) / config.bin
    height, width = config.frame_shape or (np.floor(places[:, ::-1].max(axis=0)).astype(int) + 1).tolist()
    if not 0 < max(height, width) <= _MOST_PX:
        raise InputError(f"{path}: the photons lie in {height}x{width} px; give frame_shape and origin, or a larger bin")
    outside = ((places < 0) | (places >= (width, height))).any(axis=1)
    if outside.any():
        x, y = values[names.x][outside][0], values[names.y][outside][0]
        raise InputError(
            f"{path}: {outside.sum():,} of {len(outside):,} photons lie outside of the {height}x{width} px, the first at "
            f"({x:g}, {y:g}); correct origin, bin or frame_shape, or leave them out"
        )
    sky = np.stack([values[name] for name in names.sky], axis=1) if names.sky else None
    shown = (frames >= 0) & (frames < (config.n_frames or np.inf))
    if not shown.any():
        raise InputError(f"{path}: no photon lies in the frames; correct start, n_frames or frame_duration")
    frames = frames[shown]
    n_frames = config.n_frames or int(frames[-1]) + 1
    return _Photons(frames, places[shown], (height, width), n_frames, None if sky is None else sky[shown])


def _open(config: EventsConfig) -> EventsSource:
    photons = _placed(config)
    return (EventsSource if photons.sky is None else SkyEventsSource)(photons, config.frame_rate_hz)


def _numbered(config: EventsConfig, name: str, when: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the frame of each photon, by the number in its list, or by its time."""
    path, first = config.path, float(when.min()) if config.start is None else config.start
    if config.frame_duration is None and (broken := np.flatnonzero(when != np.floor(when))).size:
        raise InputError(
            f"{path}: column {name!r} has times, such as {when[broken[0]]:.10g}, not numbers of frames; write "
            "frame_duration, in their unit"
        )
    frames = np.floor((when - first) / (config.frame_duration or 1)).astype(np.int64)
    if (fallen := np.flatnonzero(np.diff(frames) < 0)).size:
        before, after = when[fallen[0] : fallen[0] + 2]
        raise InputError(
            f"{path}: column {name!r} falls from {before:.10g} to {after:.10g} at row {fallen[0] + 1}, from 0; sort the list "
            "by it, or unwrap the counter that began anew"
        )
    lit = len(np.unique(frames)) / (frames[-1] + 1 - min(int(frames[0]), 0))
    if config.n_frames is None and lit < _LEAST_SHARE:
        raise InputError(
            f"{path}: {lit:.1g} of {frames[-1] + 1:,} frames hold a photon; column {name!r} holds times: write a (longer) "
            "frame_duration, in their unit, or n_frames"
        )
    return frames


def _of_chips(config: EventsConfig, chips: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much the chip of each photon is moved: (N, 2)."""
    known, index = np.unique(chips.astype(int), return_inverse=True)
    moves = config.chips or {}
    if lacking := [chip for chip in known.tolist() if chip not in moves]:
        raise InputError(f"{config.path} has photons of the chips {', '.join(map(str, known))}; `chips` lacks {lacking[0]}")
    return np.array([moves[chip] for chip in known.tolist()], float)[index]


def _named(path: Path, names: list[str], *, timed: bool = False) -> ColumnsConfig:
    """Return the columns of a list by their usual names; the first three, where they are numbered."""
    if names[0] == "0":
        return ColumnsConfig(when="0", x="1", y="2")
    known = {name.lower(): name for name in names}
    when = next((known[each] for each in (_TIMES if timed else _FRAMES + _TIMES) if each in known), None)
    place = next((each for each in _PLACES if set(each) <= known.keys()), None)
    if when is None or place is None:
        raise InputError(
            f"{path}: of the columns {', '.join(names)}, it is unknown which hold a photon's frame and pixel; {_NAME_THEM}"
        )
    sky = (known["x"], known["y"]) if place != _SKY and set(_SKY) <= known.keys() else None
    return ColumnsConfig(when=when, x=known[place[0]], y=known[place[1]], sky=sky)


class _Table(NamedTuple):
    """The columns of a list. Only its beginning was read."""

    names: list[str]  # their numbers from 0, where they have no names
    read: Callable[[Sequence[str]], Mapping[str, NDArray[Any]]]  # returns some columns, whole


def _table(path: Path) -> _Table:
    require_readable(path)
    if _is_fits(path):
        return _fits_table(path)
    if path.suffix.lower() == ".npz":
        with reading(path, _DAMAGED), np.load(path, allow_pickle=False) as archive:
            names = list(archive.files)

        def read(used: Sequence[str]) -> Mapping[str, NDArray[Any]]:
            with np.load(path, allow_pickle=False) as archive:
                return {name: archive[name] for name in used}

        return _Table(names, read)
    if path.suffix.lower() != ".npy":
        return _csv_table(path)
    with reading(path, _DAMAGED):
        rows = np.load(path, "r", allow_pickle=False)
    if rows.dtype.names:
        return _Table(list(rows.dtype.names), lambda used: {name: rows[name] for name in used})
    if rows.ndim != 2 or rows.shape[1] < _FEWEST or rows.dtype == bool:
        found = f"{rows.dtype} of the shape {rows.shape}"
        raise InputError(f"{path} holds {found}; a list of photons has a row for each, of frame or time, x and y")
    return _Table([str(number) for number in range(rows.shape[1])], lambda used: {name: rows[:, int(name)] for name in used})


def _csv_table(path: Path) -> _Table:
    with reading(path), path.open(encoding="utf-8", errors="replace") as file:
        fields = [field.strip().strip('"') for field in file.readline().lstrip("#").split(",")]
    try:
        [float(field) for field in fields]
    except ValueError:
        names, headers = fields, 1
    else:
        names, headers = [str(number) for number in range(len(fields))], 0

    def read(used: Sequence[str]) -> Mapping[str, NDArray[Any]]:
        places = [names.index(name) for name in used]
        try:
            rows = np.loadtxt(path, delimiter=",", ndmin=2, skiprows=headers, usecols=places)
        except ValueError as error:
            raise InputError(f"{path} is not a list of numbers: {error}") from error
        return dict(zip(used, rows.T, strict=True))

    return _Table(names, read)


def _is_fits(path: Path) -> bool:
    start = read_start(path, 30)
    if start.startswith(b"\x1f\x8b"):
        with reading(path, _DAMAGED), gzip.open(path) as unpacked:
            start = unpacked.read(30)
    return start.startswith(b"SIMPLE  =")


def _fits_table(path: Path) -> _Table:
    fits = library("astropy.io.fits", "photonpano[fits]", f"{path}, a FITS file,")
    with reading(path, _DAMAGED), fits.open(path) as units:
        tables = {unit.name: number for number, unit in reversed([*enumerate(units)]) if isinstance(unit, fits.BinTableHDU)}
        if not tables:
            raise InputError(f"{path} holds an image, and no table of photons; read pictures with image-folder")
        number = tables.get("EVENTS", min(tables.values()))
        names = list(units[number].columns.names)

    def read(used: Sequence[str]) -> Mapping[str, NDArray[Any]]:
        with fits.open(path) as units:
            return {name: np.array(units[number].data[name]) for name in used}

    return _Table(names, read)


def _recognise(path: Path) -> Recognised | None:
    """Take a file whose columns have the usual names, or none, and number the frames."""
    if not path.is_file() or not path.name.lower().endswith((".npy", *_SUFFIXES)):
        return None
    try:
        names = _named(path, _table(path).names)
    except InputError:
        return None
    if names.when.lower() not in ("0", *_FRAMES):
        return None
    unnamed = "rows of frame, x and y" if names.when == "0" else f"columns {names.when}, {names.x} and {names.y}"
    return Recognised({"path": as_written(path)}, f"a list of photons: it holds {unnamed}")


EVENTS = SourceContribution(
    name="events",
    summary="Lists of single photons, with frame or time and pixel, in .npy, .npz, .csv or FITS tables",
    config=EventsConfig,
    build=lambda config, _: _open(config),
    check=lambda config: objections(_placed, config),
    recognise=_recognise,
    suffixes=_SUFFIXES,
)
