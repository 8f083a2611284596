"""Light that changes while a capture is taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photonpano.values.arrays import BoolArray, FloatArray, FluxImage, Homography
from photonpano.values.frames import FrameSpan

_CLASSES = 8  # most classes into which frames are divided by their gain, or by the phase of the lamps
_CLASS_WIDTH = 0.1  # least range of the gains of a class


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """The light of each frame, relative to its mean.

    The gain of the frame t at a place x of the scene is `gain[t] (1 + sum_k waves[k, t] maps[k](x))`. It is the light there,
    relative to the mean over time.

    Attributes:
        gain: (T,) float64, not negative: of all of the scene.
        waves: (K, T) float64, cosine and sine of the lamps, between -1 and 1; (0, T) if all of the scene has one gain.
        maps: (K, h, w) float32, their amplitude at places of the scene.
        to_map: (3, 3), pixels of the reference plane to pixels of `maps`; on a sphere (a, b, 1) to pixels, as that of a canvas.
        frequency: flickers in a frame period; 0 for light that does not flicker.
        std: (T,) standard deviation of `gain` by photon noise; infinite for frames that are left out, whose gain is 0.
        camera_matrix: (3, 3) of the reference camera around which `maps` lie on a sphere; None if they lie on its plane.
    """

    gain: FloatArray
    waves: FloatArray
    maps: FluxImage
    to_map: Homography
    frequency: float
    std: FloatArray
    camera_matrix: FloatArray | None = None

    @classmethod
    def of_frames(cls, gain: FloatArray, frequency: float = 0.0, std: FloatArray | None = None) -> Light:
        """Return light of (T,) gains that is the same all over the scene; their (T,) standard deviations are 0 by default."""
        nothing = np.zeros_like(gain) if std is None else std
        return cls(gain, np.zeros((0, len(gain))), np.zeros((0, 1, 1), np.float32), np.eye(3), frequency, nothing)

    @property
    def has_lamps(self) -> bool:
        """Whether the gain depends on the place."""
        return len(self.waves) > 0

    @property
    def shown(self) -> BoolArray:
        """(T,) False for frames that are left out, such as those behind a closed shutter."""
        return np.isfinite(self.std)

    def leaving_out(self, shown: BoolArray) -> Light:
        """Return this light without the frames that are not `shown`, (T,), relative to the mean of the others."""
        mean = float(self.gain[shown].mean())
        return replace(self, gain=np.where(shown, self.gain / mean, 0), std=np.where(shown, self.std / mean, np.inf))

    def terms(self, span: FrameSpan) -> FloatArray:
        """Return the terms of the gain in each frame of a span: (1 + K, n), the first for all of the scene."""
        frames = slice(span.start, span.stop)
        return np.concatenate([self.gain[None, frames], self.gain[frames] * self.waves[:, frames]])

    def mean(self, span: FrameSpan) -> float:
        """Return the mean over the frames of a span of the gain of all of the scene."""
        return float(self.gain[span.start : span.stop].mean())

    def part(self, span: FrameSpan) -> Light:
        """Return the light of some frames."""
        frames = slice(span.start, span.stop)
        return replace(self, gain=self.gain[frames], waves=self.waves[:, frames], std=self.std[frames])

    def classes(self) -> NDArray[np.int64]:
        """Return the class of each frame: (T,), from 0. Within a class the gain of each place hardly changes."""
        if self.has_lamps:
            phase = np.arctan2(self.waves[1], self.waves[0]) / (2 * np.pi)
            return np.asarray(np.floor(phase % 1 * _CLASSES), np.int64) % _CLASSES
        low, high = float(self.gain.min()), float(self.gain.max())
        number = int(np.clip(np.ceil((high - low) / _CLASS_WIDTH), 1, _CLASSES))
        return np.asarray(np.clip((self.gain - low) / max(high - low, 1e-12) * number, 0, number - 1), np.int64)
