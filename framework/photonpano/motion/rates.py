"""Angular rates of a camera, as a gyroscope measured them: their file, and the rotations that they add up to."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano.errors import InputError
from photonpano.geometry import rotation_matrices
from photonpano.values import FloatArray

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

_COLUMNS = "t_s, wx_rad_s, wy_rad_s, wz_rad_s, or wx_deg_s, wy_deg_s, wz_deg_s for degrees"
_FEWEST = 4
_FASTEST_RAD_S = 35.0  # 2,000 deg/s, the range of gyroscopes in phones and drones
_GAP = 5.0  # steps from one sample to the next that are longer than the median by this factor are gaps


@dataclass(frozen=True, eq=False)
class Rates:
    """Angular rates about the axes of the camera: x right, y down, z ahead; right-handed."""

    file: Path
    times_s: FloatArray  # (N,) increasing
    rad_s: FloatArray  # (N, 3)

    def about(self, axes: FloatArray) -> Rates:
        """Return the rates about other axes, the rows of (3, 3)."""
        return replace(self, rad_s=self.rad_s @ axes.T)

    def rotations(self, times_s: FloatArray, bias_rad_s: FloatArray) -> FloatArray:
        """Return the rotations from the camera at N increasing times to that at the first of them: (N, 3, 3).

        The rates are what was measured without the (3,) bias; before the first and after the last sample, the camera rests.
        """
        inside = np.clip(times_s, *self.times_s[[0, -1]])
        steps = rotation_matrices(np.diff(self._integral(inside) - inside[:, None] * bias_rad_s, axis=0))
        found = np.tile(np.eye(3), (len(inside), 1, 1))
        for index, step in enumerate(steps):
            found[index + 1] = found[index] @ step
        return found

    def require_covered(self, frames_s: FloatArray) -> None:
        """Raise an `InputError` if frames, at (T,) increasing times, lie before, after, or in a gap between the samples."""
        first, last = self.times_s[[0, -1]]
        if (lost := np.flatnonzero((frames_s < first) | (frames_s > last))).size:
            raise InputError(
                f"{self.file} holds rates from {first:g} to {last:g} s, and the frames were taken from {frames_s[0]:g} to "
                f"{frames_s[-1]:g} s: {len(lost)} of them, from {lost[0]} to {lost[-1]}, are without; correct "
                "motion.prior.time_offset_s, or leave them out (source: with: frames)"
            )
        steps = np.diff(self.times_s)
        for gap in np.flatnonzero(steps > _GAP * np.median(steps)):
            start, stop = np.searchsorted(frames_s, self.times_s[gap : gap + 2])
            if start < stop:
                raise InputError(
                    f"{self.file} holds no rates from {self.times_s[gap]:g} to {self.times_s[gap + 1]:g} s, when the frames "
                    f"{start} to {stop - 1} were taken; take those before or after (source: with: frames)"
                )

    @cached_property
    def _integral(self) -> PPoly:
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.times_s, self.rad_s).antiderivative()


def read_rates(file: Path) -> Rates:
    """Read the rates of a gyroscope, about its own axes, from a CSV file whose header names their units.

    Raises:
        InputError: the file cannot be read, lacks columns, its times do not increase, or its rates are impossible.
    """
    try:
        with file.open(encoding="utf-8-sig", newline="") as text:
            reader = csv.reader(text)
            names = [name.strip() for name in next(reader, ())]
            time = next((name for name in ("t_s", "time_s") if name in names), "")
            unit = next((unit for unit in ("rad_s", "deg_s") if {f"w{axis}_{unit}" for axis in "xyz"} <= set(names)), "")
            if not (time and unit):
                raise InputError(f"{file}: the first line must name the columns {_COLUMNS}; it is {','.join(names)!r}")
            columns = {name: names.index(name) for name in (time, *(f"w{axis}_{unit}" for axis in "xyz"))}
            numbers = np.array([*_samples(reader, columns, file)])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file} cannot be read: {error}") from error
    if len(numbers) < _FEWEST or not np.isfinite(numbers).all():
        raise InputError(f"{file} must hold at least {_FEWEST} samples, and no NaN or infinite numbers")
    times_s, rates = numbers[:, 0], numbers[:, 1:]
    if (back := np.flatnonzero(np.diff(times_s) <= 0)).size:
        raise InputError(f"{file}: {times_s[back[0] + 1]:.9g} s follows {times_s[back[0]]:.9g} s; sort its lines by time")
    rad_s = np.deg2rad(rates) if unit == "deg_s" else rates
    if (fastest := float(np.abs(rad_s).max())) > _FASTEST_RAD_S:
        degrees = "; if they are in deg/s, name the columns wx_deg_s, wy_deg_s, wz_deg_s" if unit == "rad_s" else ""
        raise InputError(f"{file} holds rates up to {fastest:.0f} rad/s, more than any usual gyroscope measures{degrees}")
    return Rates(file, times_s, rad_s)


def _samples(reader: Any, columns: dict[str, int], file: Path) -> Iterator[list[float]]:
    """Yield the numbers of each line of a `csv.reader` in some columns."""
    for row in filter(None, reader):
        try:
            yield [float(row[place]) for place in columns.values()]
        except (ValueError, IndexError):
            line, named = f"{file}, line {reader.line_num}", ", ".join(columns)
            raise InputError(f"{line}: expected a number for each of {named}, got {','.join(row)!r}") from None
