"""The config of a camera that travels: scene, path, moving objects."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from photonpano import Config, SpecPath
from photonpano_simulator.config import Distortion, Drift, Drops, FrameCount, FrameRate, FrameShape, Repeats, Sensor, Shake

Metres = Annotated[float, Field(ge=-1000, le=1000)]
Point = tuple[Metres, Metres, Metres]
Share = Annotated[float, Field(gt=0, le=2)]
Place = Annotated[float, Field(ge=-1, le=2)]
Speed = Annotated[float, Field(ge=-100, le=100)]

# Bounds of the focal length, in widths of a frame: 127 degrees, and 0.57 degrees across a frame
_WIDEST, _NARROWEST = 0.25, 100.0


class _Scene(Config):
    seed: int = Field(0, ge=0, description="another seed is another scene of this kind")
    photo: SpecPath | None = Field(
        None,
        description="a photograph that is hung in the scene: as the pictures of a room, as the house of a facade, or on all "
        "planes; by default these are drawn",
    )


class RoomScene(_Scene):
    """A furnished room of about 5 m x 2.6 m x 5.5 m, seen from its middle at the height of the eyes."""

    kind: Literal["room"] = Field("room", description="a furnished room")


class FacadeScene(_Scene):
    """A street of shops 8 m ahead, with poles, benches, a kiosk and signs before it."""

    kind: Literal["facade"] = Field("facade", description="a street of shops, with things before it")


class PlanesScene(_Scene):
    """Seven textured rectangles at 3 to 7 m, and a background at 10 m, all facing the camera."""

    kind: Literal["planes"] = Field("planes", description="seven rectangles before a background")


class Tremor(Shake):
    """Tremor of a camera that is held: of its rotation, as in `Shake`, and of its position, at the same frequencies."""

    rms_mm: float = Field(
        0.5, ge=0, le=100, description="root mean square of the displacement of the camera along each axis, in mm"
    )


class _Path(Config):
    centre: Point = Field(
        (0.0, 0.0, 0.0), description="(x, y, z) of the middle of the path in the scene, in m: x right, y down, z ahead"
    )
    look_at: Point | None = Field(
        None, description="(x, y, z) of the point that the camera looks at, in m; by default the middle of the scene"
    )
    seed: int = Field(0, ge=0, description="another seed is another path")
    tremor: Tremor | None = Field(None, description="tremor of the camera, added to the path; none by default")


class TravelPath(_Path):
    """A smooth path by chance through space, whose speed changes on the way, while the gaze wanders."""

    kind: Literal["travel"] = Field("travel", description="a smooth random path through space")
    length_m: float = Field(0.5, gt=0, le=100, description="length of the path, without the tremor, in m")
    knots: int = Field(5, ge=3, le=1000, description="number of random points that the path passes through")
    wander_deg: float = Field(
        2.0, ge=0, le=45, description="how far the gaze wanders from look_at, and the camera rolls, in degrees"
    )


class TurnOnlyPath(_Path):
    """A turn about the centre at constant speed, to the right: without parallax."""

    kind: Literal["turn-only"] = Field("turn-only", description="a turn on the spot, without parallax")
    degrees: float = Field(
        10.0,
        ge=-360,
        le=360,
        description="angle of the turn in degrees: to the right, or below 0 to the left; look_at is its middle",
    )


class WorldObject(Config):
    """A textured thing that moves on its own: it faces the first frame, and keeps its distance from where that was."""

    shape: Literal["rectangle", "disc"] = Field("disc", description="a rectangle, or the largest disc that fits into it")
    size: tuple[Share, Share] = Field(
        (0.3, 0.3), description="width and height in the first frame, as shares of those of the frame"
    )
    at: tuple[Place, Place] = Field(
        (0.5, 0.5), description="(x, y) of its middle in the first frame, as shares of the width and the height of the frame"
    )
    distance_m: float = Field(1.5, ge=0.2, le=1000, description="its depth, seen from the first frame, in m")
    moves_px: tuple[Speed, Speed] = Field(
        (0.05, 0.0), description="its own motion, (x, y) in px per frame, seen from the first frame"
    )
    flux: float = Field(1.0, ge=0, le=1000, description="its mean flux, relative to that of the scene")
    seed: int = Field(0, ge=0, description="another seed is another texture")


class TravelConfig(Config):
    """A single-photon camera that travels through a scene with depth."""

    scene: Annotated[RoomScene | FacadeScene | PlanesScene, Field(discriminator="kind")] = Field(
        RoomScene(), description="the scene"
    )
    path: Annotated[TravelPath | TurnOnlyPath, Field(discriminator="kind")] = Field(
        TravelPath(), description="the path of the camera"
    )
    objects: tuple[WorldObject, ...] = Field((), max_length=20, description="things that move on their own")
    flux: float = Field(
        0.3,
        gt=0,
        le=1000,
        description="incident photons per pixel per frame, averaged over frames all along the path; the sensor detects "
        "quantum_efficiency times as many",
    )
    drift: Drift = 1.0
    n_frames: FrameCount = 5000
    frame_shape: FrameShape = (254, 496)
    frame_rate_hz: FrameRate = 10_000.0
    focal_px: float = Field(
        400.0,
        gt=0,
        le=1e6,
        description="focal length of the camera, in px: from a quarter of the width of a frame, which sees 127 degrees across, "
        "to 100 widths",
    )
    centre_px: tuple[float, float] | None = Field(
        None, description="(x, y) of the principal point, in px; by default the middle of the frame"
    )
    distortion: Distortion = Field(Distortion(), description="distortion of the lens by OpenCV's model")
    drops: Drops = ()
    repeats: Repeats = ()
    seed: int | None = Field(None, ge=0, description="seed of photons, pixels and tremor; by default the seed of the run")
    sensor: Sensor = Field(Sensor(), description="the single-photon camera")

    @model_validator(mode="after")
    def _camera_sees_a_scene(self) -> Self:
        height, width = self.frame_shape
        if not _WIDEST * width <= self.focal_px <= _NARROWEST * width:
            raise ValueError(
                f"focal_px of {self.focal_px:g} does not fit frames {width} px wide; "
                f"take {_WIDEST * width:g} to {_NARROWEST * width:g} px"
            )
        if self.centre_px is not None and not (0 <= self.centre_px[0] < width and 0 <= self.centre_px[1] < height):
            raise ValueError(f"centre_px {self.centre_px} lies outside the frame of {height}x{width} px")
        if self.sensor.filters is not None:
            raise ValueError("sensor.filters: scenes with depth are grey; leave the colour filters out")
        return self
