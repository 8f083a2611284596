"""The config of the simulator: scene, camera path, lens, sensor, and what disturbs a capture.

Frames, rate, light, shake, and dropped and repeated frames are keys of all simulated captures.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from photonpano import Bayer, Config, InputError, SpecPath


class FrameRange(Config):
    """Successive frames, counted before any are dropped or repeated."""

    at: int = Field(ge=0, description="index of the first frame, counted before any are dropped or repeated")
    frames: int = Field(1, ge=1, le=10_000_000, description="number of frames")


Side: TypeAlias = Annotated[int, Field(ge=8, le=8192)]

FrameCount: TypeAlias = Annotated[int, Field(ge=1, le=10_000_000, description="number of frames that the camera takes")]
FrameShape: TypeAlias = Annotated[tuple[Side, Side], Field(description="height and width of a frame, in px")]
FrameRate: TypeAlias = Annotated[float, Field(gt=0, le=1e9, description="frames a second, in Hz")]
Drift: TypeAlias = Annotated[
    float,
    Field(
        ge=1e-3,
        le=1e3,
        description="light of the last frame divided by that of the first; between them it changes exponentially",
    ),
]
Drops: TypeAlias = Annotated[tuple[FrameRange, ...], Field(description="frames that are missing in the capture")]
Repeats: TypeAlias = Annotated[
    tuple[FrameRange, ...],
    Field(description="frames that the capture holds twice: all of the range, and then all of it again"),
]


def _ordered(part: tuple[float, float]) -> tuple[float, float]:
    if part[0] >= part[1]:
        raise ValueError(f"{list(part)} is no part of the capture: its start is not before its stop; give [start, stop]")
    return part


_Share = Annotated[float, Field(ge=0, le=1)]
Part: TypeAlias = Annotated[tuple[_Share, _Share], AfterValidator(_ordered)]


def within(parts: tuple[tuple[float, float], ...], n_frames: int) -> NDArray[np.bool_]:
    """Return which frames lie in parts of the capture, given as shares of its length: (n_frames,)."""
    found = np.zeros(n_frames, dtype=bool)
    for start, stop in parts:
        found[round(start * n_frames) : round(stop * n_frames)] = True
    return found


def delivered(n_frames: int, drops: tuple[FrameRange, ...], repeats: tuple[FrameRange, ...]) -> NDArray[np.int64]:
    """Return, for each frame of the capture, the index of the frame that the camera took.

    Raises an `InputError` if a range lies beyond the last frame, or no frame is left.
    """
    for key, ranges in (("drops", drops), ("repeats", repeats)):
        for each in ranges:
            if each.at + each.frames > n_frames:
                raise InputError(
                    f"{key} names the frames {each.at} to {each.at + each.frames - 1}, but the camera takes {n_frames} "
                    f"frames (0 to {n_frames - 1}); shorten the range, or raise n_frames"
                )
    # A repeated range follows its own last frame: a stable sort by where a frame comes puts it there.
    taken = [np.arange(n_frames), *(np.arange(each.at, each.at + each.frames) for each in repeats)]
    places = [np.arange(n_frames), *(np.full(each.frames, each.at + each.frames - 1) for each in repeats)]
    order = np.concatenate(taken)[np.argsort(np.concatenate(places), kind="stable")]
    kept = np.ones(n_frames, dtype=bool)
    for each in drops:
        kept[each.at : each.at + each.frames] = False
    if not kept.any():
        raise InputError(f"drops leaves none of the {n_frames} frames; drop fewer of them")
    return order[kept[order]]


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


class StreetScene(Config):
    """The scene that is built in: a street of shops, drawn anew for every seed."""

    kind: Literal["street"] = Field("street", description="the built-in scene")
    width: int = Field(2048, ge=64, le=16384, description="in px; a wider street has more houses")
    height: int = Field(1365, ge=64, le=16384, description="in px; a higher street is the same one, larger")
    seed: int = Field(0, ge=0, description="another seed is another street")


class NightScene(Config):
    """The street at night: lamps, lit windows, and shadows in between."""

    kind: Literal["night"] = Field("night", description="the built-in scene at night")
    width: int = Field(2048, ge=64, le=16384, description="in px; a wider street has more houses and lamps")
    height: int = Field(1365, ge=64, le=16384, description="in px; a higher street is the same one, larger")
    seed: int = Field(0, ge=0, description="another seed is another street")
    range_db: float = Field(
        120.0,
        ge=20,
        le=200,
        description="flux of the brightest pixel divided by that of the darkest, in dB: 20 dB are a factor of ten. The lamps "
        "take most of the mean flux",
    )


class PhotoScene(Config):
    """A photograph: sRGB of 8 or 16 bits, undone to linear. A sensor without colour filters sees its luminance."""

    kind: Literal["photo"] = Field("photo", description="a photograph")
    file: SpecPath = Field(description="an image file that OpenCV reads, such as JPEG, PNG or TIFF")
    width: int | None = Field(
        None, ge=64, le=16384, description="in px: the photograph is resized to this width; by default it is not resized"
    )


Rate = Annotated[float, Field(gt=0, le=100)]
Size = Annotated[float, Field(gt=0, le=10)]
Place = Annotated[float, Field(ge=-10, le=10)]
Speed = Annotated[float, Field(ge=-100, le=100)]
Angle = Annotated[float, Field(ge=-360, le=360)]
Length = Annotated[float, Field(gt=0, le=100)]


class Lens(Config):
    """What the lens of the camera does to the image.

    A pixel at the distance r from the middle of the frame, in half-diagonals of the frame, shows what a lens without
    distortion images at the distance `r / (1 + k1 r^2 + k2 r^4)` in the same direction (the division model of Fitzgibbon,
    CVPR 2001). The light that reaches it is `1 - vignette r^2` of that in the middle.
    """

    k1: float = Field(
        0.0,
        ge=-0.2,
        le=0.2,
        description="radial distortion: relative displacement at the corner, where -0.03 is a barrel of 3 %. A pixel at r "
        "half-diagonals from the middle shows what an ideal lens images at r / (1 + k1 r^2 + k2 r^4)",
    )
    k2: float = Field(0.0, ge=-0.2, le=0.2, description="radial distortion of fourth order, see k1")
    vignette: float = Field(
        0.0, ge=0, le=1, description="fraction of the light that is lost at the corner; it grows with the square of r"
    )


class Distortion(Config):
    """Distortion of the lens by the model of OpenCV, in focal lengths from the middle of the frame.

    What an ideal lens images at (x, y), this lens images at x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2), and y
    likewise.
    """

    k1: float = Field(0.0, ge=-2, le=2, description="radial distortion of second order: below 0 it is a barrel")
    k2: float = Field(0.0, ge=-2, le=2, description="radial distortion of fourth order")
    p1: float = Field(0.0, ge=-0.5, le=0.5, description="tangential distortion along y")
    p2: float = Field(0.0, ge=-0.5, le=0.5, description="tangential distortion along x")

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """k1, k2, p1, p2."""
        return self.k1, self.k2, self.p1, self.p2


class Dirt(Config):
    """Specks on the window of the sensor, which stand still in the frame."""

    specks: int = Field(20, ge=1, le=10_000, description="number of specks, at random places")
    radius_px: float = Field(6.0, gt=0, le=1000, description="standard deviation of the Gaussian shape of a speck, in px")
    loss: float = Field(0.8, gt=0, le=1, description="fraction of the light that is lost in the middle of a speck")


class Sensor(Config):
    """A single-photon camera: a pixel of a frame is 1 if it detected at least one photon."""

    quantum_efficiency: float = Field(1.0, gt=0, le=1, description="fraction of the incident photons that are detected")
    dark_rate: float = Field(0.0, ge=0, le=100, description="dark counts per pixel per frame")
    dark_rates: SpecPath | None = Field(
        None, description="a .npy file of frame shape: dark counts per frame of each pixel, on top of dark_rate"
    )
    hot_fraction: float = Field(0.0, ge=0, le=1, description="fraction of pixels that are hot, at random places")
    hot_pixels: SpecPath | None = Field(None, description="a bool .npy file of frame shape, true for further hot pixels")
    hot_rate: tuple[Rate, Rate] = Field(
        (0.05, 2.0),
        description="dark counts per frame of a hot pixel, drawn log-uniformly between these two",
    )
    mask_hot_pixels: bool = Field(False, description="whether hot pixels are masked")
    gain_std: float = Field(
        0.0,
        ge=0,
        le=0.3,
        description="standard deviation of the sensitivity of the pixels, relative to its mean; it does not change with time",
    )
    dirt: Dirt | None = Field(None, description="specks on the window of the sensor; none by default")
    afterpulsing: float = Field(
        0.0, ge=0, le=1, description="probability that a pixel that detected a photon, or a dark count, fires in the next frame"
    )
    crosstalk: float = Field(
        0.0, ge=0, le=1, description="probability that a pixel that fires triggers each of its four neighbours in this frame"
    )
    dead_time: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="time for which a pixel is blind after each detection, in frame periods; after a late one, at the "
        "start of the next frame",
    )
    filters: Bayer | SpecPath | None = Field(
        None,
        description="colour filters before the pixels: rggb, bggr, grbg or gbrg for a Bayer array, or a file as that of the "
        "correction colour-filter; none by default. The scene is then in colour, and flux is that of clear pixels, which see "
        "the sum of red, green and blue",
    )


class IntensitySensor(Config):
    """A conventional camera, whose pixels count photons, which are read with noise as grey levels."""

    bits: Literal[8, 10, 12, 16] = Field(8, description="bits of a grey level")
    quantum_efficiency: float = Field(1.0, gt=0, le=1, description="fraction of the incident photons that are detected")
    full_well: float = Field(
        10_000.0, ge=1, le=1e9, description="detected photons at the highest grey level, where a pixel saturates"
    )
    read_noise: float = Field(20.0, ge=0, le=1e6, description="standard deviation of the read noise, in photons")
    black_level: int = Field(0, ge=0, le=200, description="grey level without light")
    exposure: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the frame period in which the shutter is open; motion blurs the frame, and the flux "
        "per frame does not depend on it",
    )


class FrameObject(Config):
    """A rectangle or a disc in front of the scene, with a texture of its own."""

    shape: Literal["rectangle", "disc"] = Field("rectangle", description="a rectangle, or the largest disc that fits into it")
    size: tuple[Size, Size] = Field(
        (0.5, 0.5), description="width and height, as shares of those of the frame; (0.5, 0.5) covers a quarter of it"
    )
    at: tuple[Place, Place] = Field(
        (0.5, 0.5),
        description="(x, y) of its middle when it appears, as shares of the width and the height of the frame, whose middle "
        "is (0.5, 0.5)",
    )
    moves_px: tuple[Speed, Speed] = Field(
        (0.0, 0.0), description="its own motion, (x, y) in px per frame; (0, 0) stands still, like a dirty window"
    )
    follows: float = Field(
        0.0,
        ge=0,
        le=10,
        description="its share in the motion of the scene through the frame: 0 stays in the frame, 1 is fixed to the scene, "
        "more is nearer to the camera",
    )
    flux: float = Field(1.0, ge=0, le=1000, description="its mean flux, relative to the mean of the scene")
    seed: int = Field(0, ge=0, description="another seed is another texture")
    first: int = Field(0, ge=0, description="index of the frame in which it appears")
    frames: int | None = Field(None, ge=1, description="number of frames in which it is there; by default all that follow")


class Board(Config):
    """A textured board at a distance, upright."""

    distance_m: float = Field(2.0, ge=0.1, le=1e4, description="horizontal distance of its middle from the first camera, in m")
    at_deg: tuple[Angle, Annotated[float, Field(ge=-80, le=80)]] = Field(
        (0.0, 0.0),
        description="(x, y) of its middle, to the right and down from the middle of the scene, in degrees: it is fixed to the "
        "scene",
    )
    size_m: tuple[Length, Length] = Field((0.5, 0.5), description="width and height in m")
    slant_deg: float = Field(
        0.0, ge=-85, le=85, description="turn about its upright axis, in degrees: above 0, its right edge is nearer"
    )
    flux: float = Field(1.0, ge=0, le=1000, description="its mean flux, relative to the mean of the scene")
    seed: int = Field(0, ge=0, description="another seed is another texture")


class _Near(Config):
    share: float = Field(gt=0, le=0.9, description="share of the pixels that they cover, on average over the capture")
    nearest_m: float = Field(1.5, ge=0.1, le=1e4, description="distance of the nearest, in m")
    farthest_m: float = Field(4.0, ge=0.1, le=1e4, description="distance of the farthest, in m")
    seed: int = Field(0, ge=0, description="another seed places and paints them anew")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.nearest_m > self.farthest_m:
            raise ValueError(f"nearest_m of {self.nearest_m:g} is above farthest_m of {self.farthest_m:g}; exchange them")
        return self


class Clutter(_Near):
    """Boards at random places and distances, all along the path."""

    number: int = Field(6, ge=1, le=50, description="number of boards")


class People(_Near):
    """People who walk through the scene, to and fro: who leaves the frame comes in again from its other side."""

    number: int = Field(3, ge=1, le=50, description="number of people")
    speed_px: float = Field(0.1, ge=0, le=100, description="how fast they walk through the scene, in px per frame")
    pauses: float = Field(0.0, ge=0, le=1, description="share of the time in which they stand still before the scene")


class Lamp(Config):
    """A lamp on the mains, whose light flickers as a sine."""

    frequency_hz: Frequency = Field(100.0, description="frequency of the light in Hz: twice that of the mains")
    depth: float = Field(
        0.5, ge=0, le=1, description="amplitude of the flicker, relative to the mean light of the lamp; at 1 it goes out"
    )
    phase_deg: float = Field(0.0, ge=-360, le=360, description="phase of the light at the first frame, in degrees")
    at: tuple[Place, Place] | None = Field(
        None,
        description="(x, y) of the place that it lights, as shares of the width and the height of the scene; by default it "
        "lights all of the scene",
    )
    radius: float = Field(
        0.3, gt=0, le=10, description="standard deviation of the Gaussian spot that it lights, as a share of the scene's height"
    )


class SimulationConfig(Config):
    """What simulations of all cameras share."""

    scene: Annotated[StreetScene | NightScene | PhotoScene, Field(discriminator="kind")] = Field(
        StreetScene(), description="the scene"
    )
    path: Annotated[
        PanPath | ScanPath | LoopPath | SplinePath | HandShakePath | TurnPath | FilePath, Field(discriminator="kind")
    ] = Field(PanPath(), description="the path of the camera")
    scene_scale: int = Field(
        1,
        ge=1,
        le=8,
        description="pixels of the scene along the side of a pixel of a frame; from 2 on, pixels of a frame have an area. "
        "Lengths of the path stay in px of a frame",
    )
    fill_factor: float = Field(
        1.0,
        gt=0,
        le=1,
        description="share of the area of a pixel that is sensitive to light; its side is rounded to whole pixels of the "
        "scene. At scene_scale 1, pixels are points",
    )
    flux: float = Field(
        0.5,
        gt=0,
        le=1000,
        description="incident photons per pixel per frame, averaged over the scene; the sensor detects "
        "quantum_efficiency times as many",
    )
    drift: Drift = 1.0
    lamps: tuple[Lamp, ...] = Field(
        (),
        max_length=16,
        description="lamps that flicker; the rest of the light is steady, and so is the mean light of each place",
    )
    n_frames: FrameCount = 2000
    frame_shape: FrameShape = (254, 496)
    frame_rate_hz: FrameRate = 96_800.0
    focal_length_px: float = Field(4464.0, ge=50, le=1e6, description="focal length of the camera, in px")
    lens: Lens = Field(Lens(), description="the lens of the camera")
    distortion: Distortion = Field(
        Distortion(), description="distortion of the lens by OpenCV's model, in place of k1 and k2 of `lens`"
    )
    objects: tuple[FrameObject, ...] = Field((), max_length=100, description="rectangles and discs in front of the scene")
    boards: tuple[Board, ...] = Field(
        (), max_length=50, description="textured boards before the scene; nearer ones hide others"
    )
    clutter: Clutter | None = Field(None, description="boards at random places; none by default")
    people: People | None = Field(None, description="people who walk through the scene; none by default")
    shutter: tuple[Part, ...] = Field(
        (),
        max_length=100,
        description="when the shutter is closed: [start, stop], as shares of the capture. There are only dark counts then",
    )
    drops: Drops = ()
    repeats: Repeats = ()
    seed: int | None = Field(None, ge=0, description="seed of photons, pixels and shake; by default the seed of the run")

    @model_validator(mode="after")
    def _one_distortion(self) -> Self:
        if any(self.distortion.coefficients) and (self.lens.k1 or self.lens.k2):
            raise ValueError("lens and distortion both distort the image; leave out one of the two models")
        return self

    @model_validator(mode="after")
    def _known_rotations(self) -> Self:
        if isinstance(self.path, FilePath) and (self.boards or self.clutter or self.people):
            raise ValueError(
                "boards, clutter and people need the rotation of the camera, which homographies from a file do not give; "
                "take another path, or objects"
            )
        return self


class SimulatorConfig(SimulationConfig):
    """A single-photon camera that turns before a scene."""

    sensor: Sensor = Field(Sensor(), description="the single-photon camera")


class CameraSimulatorConfig(SimulationConfig):
    """A conventional high-speed camera that turns before a scene."""

    flux: float = Field(
        2000.0,
        gt=0,
        le=1e9,
        description="incident photons per pixel per frame, averaged over the scene; the sensor detects "
        "quantum_efficiency times as many",
    )
    n_frames: FrameCount = 200
    frame_rate_hz: FrameRate = 500.0
    sensor: IntensitySensor = Field(IntensitySensor(), description="the camera")
