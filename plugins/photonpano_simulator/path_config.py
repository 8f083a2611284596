"""The config of the paths of a camera that turns."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from photonpano import Config, SpecPath
from photonpano_simulator.recording import Part

Frequency = Annotated[float, Field(gt=0, le=1e6)]
Metres = Annotated[float, Field(ge=-100, le=100)]


class Shake(Config):
    """Tremor along x, along y and as a roll: a sum of sines each, with random phases."""

    rms_px: float = Field(1.0, gt=0, le=100, description="root mean square of the displacement along x, and along y, in px")
    roll_rms_deg: float = Field(0.05, ge=0, le=5, description="root mean square of the roll about the optical axis, in degrees")
    frequencies_hz: tuple[Frequency, ...] = Field(
        (25.0, 90.0, 210.0),
        min_length=1,
        max_length=64,
        description="frequencies of the sines, in Hz, which share the power equally; the default is a hand's tremor, and a "
        "motor or a fan adds frequencies up to thousands",
    )


class Jump(Config):
    """A place where the capture is cut: two shots of one path."""

    at: float = Field(gt=0, lt=1, description="when the camera jumps, as a share of the capture")
    by: float = Field(
        ge=-10, le=10, description="how far it jumps ahead, or below 0 back, as a share of the length of the path"
    )


class MovingPath(Config):
    """A path that leads somewhere."""

    shake: Shake | None = Field(None, description="tremor of the camera, added to the path; none by default")
    rests: tuple[Part, ...] = Field(
        (),
        max_length=100,
        description="when the camera rests: [start, stop], as shares of the capture. It slows down before, and the path stays "
        "the same",
    )
    jumps: tuple[Jump, ...] = Field(
        (),
        max_length=100,
        description="jumps along the path: the capture has several shots, which still begin and end with the path. What it "
        "skips by jumps ahead is not seen, and what it jumps back is seen twice",
    )
    travel_m: tuple[Metres, Metres, Metres] = Field(
        (0.0, 0.0, 0.0),
        description="(x, y, z) of the way that the camera travels along the path, smoothly, in m: to the right, down and ahead "
        "of a camera before the middle of the scene, which is infinitely far; it moves boards, clutter and people in the frame",
    )


class _Aimed(Config):
    centre: tuple[float, float] | None = Field(
        None, description="(x, y) of the middle of the path in the scene, in px; by default the middle of the scene"
    )


class _Line(MovingPath, _Aimed):
    length_px: float = Field(
        300.0, gt=0, le=1e6, description="length of the path of the frame centre over the scene, without the shake, in px"
    )


class PanPath(_Line):
    """A straight pan at constant speed."""

    kind: Literal["pan"] = Field("pan", description="a straight line")
    angle_deg: float = Field(0.0, ge=-360, le=360, description="direction in degrees: 0 is to the right, 90 is down")


class ScanPath(_Line):
    """A raster at constant speed: rows to and fro, joined by half circles; neighbouring rows see the same places again."""

    kind: Literal["scan"] = Field("scan", description="a raster")
    rows: int = Field(3, ge=2, le=100, description="number of rows")
    row_spacing_px: float = Field(100.0, gt=0, le=1e4, description="distance between neighbouring rows, in px")


class LoopPath(_Line):
    """An ellipse at constant speed, once around: the last frame lies where the first does."""

    kind: Literal["loop"] = Field("loop", description="an ellipse, once around")
    aspect: float = Field(2.0, ge=0.1, le=10, description="width of the ellipse divided by its height")


class SplinePath(_Line):
    """A smooth path by chance, whose speed changes on the way."""

    kind: Literal["random-spline"] = Field("random-spline", description="a smooth random path")
    knots: int = Field(6, ge=3, le=1000, description="number of random points that the spline passes through")
    seed: int = Field(0, ge=0, description="another seed is another path")


class HandShakePath(_Aimed):
    """A camera that somebody tries to hold still."""

    kind: Literal["hand-shake"] = Field("hand-shake", description="tremor only")
    shake: Shake = Field(Shake(rms_px=5.0), description="the tremor")


class TurnPath(MovingPath):
    """A turn about the vertical axis at constant speed, by any angle; the scene surrounds the camera.

    The scene is an equirectangular panorama: its width is 360 degrees, its ends meet, and the horizon is its middle row. The
    turn starts at its middle.
    """

    kind: Literal["turn"] = Field("turn", description="a turn before a scene all around the camera")
    degrees: float = Field(
        360.0, ge=-3600, le=3600, description="angle of the turn in degrees: to the right, or below 0 to the left"
    )
    pitch_wobble_deg: float = Field(0.0, ge=0, le=45, description="amplitude with which the camera nods, as a sine, in degrees")
    roll_wobble_deg: float = Field(0.0, ge=0, le=45, description="amplitude with which it rolls, as a cosine, in degrees")
    wobbles: float = Field(5.0, ge=0, le=1e4, description="periods of these wobbles during the turn")


class FilePath(MovingPath):
    """Homographies from a file."""

    kind: Literal["file"] = Field("file", description="homographies from a file")
    file: SpecPath = Field(
        description="a .npy file (n_frames, 3, 3), or an .npz file with an array `homographies` of this shape, such "
        "as the truth of another simulation: pixels of a frame to pixels of the scene"
    )
