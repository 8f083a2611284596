"""What refiners exchange with the framework: residuals of short spans of frames, and a refined motion."""

from __future__ import annotations

from dataclasses import dataclass

from photonpano.values.arrays import FloatArray
from photonpano.values.frames import FrameSpan


@dataclass(frozen=True, slots=True, eq=False)
class SpanResiduals:
    """What the frames of short spans show of the motion, beyond a trajectory.

    Convention:
        A step moves points of a frame: what the frames of a span show at the point q, the trajectory predicts at `step(q)`. So
        `trajectory.at(frame) @ step` explains the photons better; `photonpano.geometry.step_motions` makes the (3, 3) matrices.
        Points are (x, y), integers are pixel centres.

    Attributes:
        spans: S spans of frames, in order; together they contain the located frames.
        steps: (S, 4) float64, one weighted least-squares step of the motion of each span: shift along x and along y, in px of a
            frame; roll from x towards y, in radians; zoom, as a fraction. Roll and zoom are about the centre of the frame.
        information: (S, 4, 4) float64, inverse covariance of the steps from photon noise alone; singular where the photons of
            a span do not determine a step, which is then 0.
    """

    spans: tuple[FrameSpan, ...]
    steps: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A motion that a refiner corrected.

    Convention:
        Homographies map pixels of a frame to pixels of the reference plane. That of the reference frame stays the identity.

    Attributes:
        homographies: (T, 3, 3) float64, one for each frame of the capture, h33 = 1.
        std_px: (T,) expected corner error of each frame, in px of a frame; infinite where it was infinite before.
        summary: what was corrected, in one line, such as "tremor of 0.9 px at 223 and 590 Hz".
    """

    homographies: FloatArray
    std_px: FloatArray
    summary: str
