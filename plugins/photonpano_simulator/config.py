"""The config of the simulator: scene, camera path, sensor."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from photonpano import Config, SpecPath


class StreetScene(Config):
    """The scene that is built in: a street of shops, drawn anew for every seed."""

    kind: Literal["street"] = Field("street", description="the built-in scene")
    width: int = Field(2048, ge=64, le=16384, description="in px; a wider street has more houses")
    height: int = Field(1365, ge=64, le=16384, description="in px; a higher street is the same one, larger")
    seed: int = Field(0, ge=0, description="another seed is another street")


class PhotoScene(Config):
    """A photograph: sRGB of 8 or 16 bits, undone to linear, of which the luminance is kept."""

    kind: Literal["photo"] = Field("photo", description="a photograph")
    file: SpecPath = Field(description="an image file that OpenCV reads, such as JPEG, PNG or TIFF")
    width: int | None = Field(
        None, ge=64, le=16384, description="in px: the photograph is resized to this width; by default it is not resized"
    )


Frequency = Annotated[float, Field(gt=0, le=1e6)]
Rate = Annotated[float, Field(gt=0, le=100)]
Side = Annotated[int, Field(ge=8, le=8192)]


class Shake(Config):
    """The trembling of a hand: along x, along y and as a roll, three sines each, with phases by chance."""

    rms_px: float = Field(1.0, gt=0, le=100, description="root mean square of the displacement along x, and along y, in px")
    roll_rms_deg: float = Field(0.05, ge=0, le=5, description="root mean square of the roll about the optical axis, in degrees")
    frequencies_hz: tuple[Frequency, Frequency, Frequency] = Field(
        (25.0, 90.0, 210.0), description="three frequencies, in Hz; each has a third of the power"
    )


class _Path(Config):
    shake: Shake | None = Field(None, description="tremor of a hand, added to the path; none by default")


class _Aimed(Config):
    centre: tuple[float, float] | None = Field(
        None, description="(x, y) of the middle of the path in the scene, in px; by default the middle of the scene"
    )


class _Line(_Path, _Aimed):
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


class FilePath(_Path):
    """Homographies from a file."""

    kind: Literal["file"] = Field("file", description="homographies from a file")
    file: SpecPath = Field(
        description="a .npy file (n_frames, 3, 3), or an .npz file with an array `homographies` of this shape, such "
        "as the truth of another simulation: pixels of a frame to pixels of the scene"
    )


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


class SimulationConfig(Config):
    """What simulations of all cameras share."""

    scene: Annotated[StreetScene | PhotoScene, Field(discriminator="kind")] = Field(StreetScene(), description="the scene")
    path: Annotated[PanPath | ScanPath | LoopPath | SplinePath | HandShakePath | FilePath, Field(discriminator="kind")] = Field(
        PanPath(), description="the path of the camera"
    )
    flux: float = Field(
        0.5,
        gt=0,
        le=1000,
        description="incident photons per pixel per frame, averaged over the scene; the sensor detects "
        "quantum_efficiency times as many",
    )
    n_frames: int = Field(2000, ge=1, le=10_000_000, description="number of frames")
    frame_shape: tuple[Side, Side] = Field((254, 496), description="height and width of a frame, in px")
    frame_rate_hz: float = Field(96_800.0, gt=0, le=1e9, description="frames a second, in Hz")
    focal_length_px: float = Field(4464.0, ge=100, le=1e6, description="focal length of the camera, in px")
    seed: int | None = Field(None, ge=0, description="seed of photons, hot pixels and shake; by default the seed of the run")


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
    n_frames: int = Field(200, ge=1, le=10_000_000, description="number of frames")
    frame_rate_hz: float = Field(500.0, gt=0, le=1e9, description="frames a second, in Hz")
    sensor: IntensitySensor = Field(IntensitySensor(), description="the camera")
