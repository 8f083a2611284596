"""The framework's own sections of a spec, with their defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ByteSize, Field, field_validator

from photonpano.geometry import ProjectionName, right_handed_axes
from photonpano.plugins.contributions import KINDS, Config, SpecPath

_Factor = Annotated[float, Field(gt=0, le=1000)]
Extent = Literal["panorama", "reference"] | tuple[int, int, int, int]


class LevelSettings(Config):
    """The settings of a level, beside the stages that it overrides."""

    scale: Literal["auto"] | Annotated[float, Field(ge=0.05, le=4)] = Field(
        "auto",
        description="pixels of the level's exposures per pixel of a frame; auto takes 0.5 at the first two levels if "
        "a later one refines them and frames are not small, otherwise 1",
    )


class GraphSettings(Config):
    """Which pairs of exposures are registered, and what happens when too few are located."""

    skips: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (1.0, 2.0, 4.0),
        description="distances, in group lengths, of the exposures that are registered with each other; an empty list "
        "registers neighbours only",
    )
    closure_overlap: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        0.5,
        description="loop closures: exposures of different times are registered if they share at least this fraction "
        "of the field of view; null disables them",
    )
    exclude: tuple[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]], ...] = Field(
        (),
        description="pairs of frames, as [[120, 900]]: exposures of which one holds the first frame and one the second are "
        "registered with each other at no level",
    )
    tie: SpecPath | None = Field(
        None,
        description="a .csv file of points that show one place in two frames: columns frame_a, x_a, y_a, frame_b, x_b, y_b, "
        "and std_px if they are not exact to 1 px. Exposures are registered from there; where that fails, the points count",
    )
    disconnected: Literal["error", "largest"] = Field(
        "error",
        description="if some exposures are not connected to the others: stop with an error that names them, or "
        "continue with the largest connected part",
    )


class PriorSettings(Config):
    """A gyroscope that was fixed to the camera."""

    imu: SpecPath = Field(
        description="a .csv file of the gyroscope's rates: columns t_s, wx_rad_s, wy_rad_s, wz_rad_s, or wx_deg_s and so on; "
        "others are ignored"
    )
    axes: str = Field(
        "x, y, z",
        description="the axes of the camera (x right, y down, z ahead) in those of the gyroscope: x, -y, -z for one whose y "
        "points up and z backwards; find takes the ones along which photons fit together best",
    )
    time_offset_s: Literal["find"] | float = Field(
        "find",
        description="time of the gyroscope at the first frame, in s; find looks through all times for which the file covers "
        "the capture",
    )
    noise_deg_s_sqrt_hz: float = Field(
        0.01,
        gt=0,
        le=10,
        description="density of its white noise, in deg/s per square root of Hz; the default is usual in phones",
    )

    @field_validator("axes", mode="after")
    @classmethod
    def _right_handed(cls, axes: str) -> str:
        if axes != "find" and axes not in right_handed_axes():
            raise ValueError(f"expected find, or three right-handed axes such as x, -y, -z, got {axes!r}")
        return axes


class MotionSettings(Config):
    """What the motion of the camera may be."""

    model: Literal["auto", "translation", "euclidean", "similarity", "affine", "homography", "rotation"] = Field(
        "auto",
        description="translation, euclidean (shift and roll), similarity (and zoom), affine or homography are for flat scenes, "
        "from the fewest numbers a frame to the most; rotation is for a camera that only turns, by any angle, about one focal "
        "length; auto takes homographies that do no more than the capture shows, or rotations where these are likelier, with a "
        "lens if pairs show one",
    )
    start: Literal["none", "constant-velocity", "smooth-path"] = Field(
        "none",
        description="what is known of the motion before the first level: none, the constant-velocity of the image, a turn "
        "about any point or a shift, or the smooth-path along which it shifts, that are found from all frames together, where "
        "groups of them are too dark or too blurred; with none, they are tried if pairs of exposures cannot be located",
    )
    prior: PriorSettings | None = Field(
        None, description="a gyroscope, whose rates tie exposures that are too dark to be located; for motion.model: rotation"
    )


Distortion = Literal["find"] | Annotated[float, Field(ge=-2, le=2)]


class DistortionSettings(Config):
    """What the lens does to the image, as OpenCV defines it, in units of the focal length."""

    k1: Distortion = Field(0.0, description="radial distortion of second order; find measures it, for the model rotation")
    k2: Distortion = Field(0.0, description="radial distortion of fourth order; find measures it, for the model rotation")
    p1: Distortion = Field(0.0, description="tangential distortion along y; find measures it, for the model rotation")
    p2: Distortion = Field(0.0, description="tangential distortion along x; find measures it, for the model rotation")


class CameraSettings(Config):
    """The camera and its lens."""

    focal_px: Literal["find"] | Annotated[float, Field(ge=10, le=1e6)] = Field(
        "find", description="focal length in px of a frame; find measures it, but not for planar models"
    )
    centre_px: tuple[float, float] | None = Field(
        None, description="(x, y) of the principal point, in px of a frame; by default the middle of the frames"
    )
    distortion: DistortionSettings = Field(DistortionSettings(), description="of the lens; none by default")


class LightSettings(Config):
    """The light of the scene."""

    mode: Literal["auto", "steady", "changing"] = Field(
        "auto",
        description="auto measures the light where the capture shows that it changes, and divides by it; steady never does, "
        "and changing always",
    )


class RenderSettings(Config):
    """The panorama."""

    scale: float = Field(1.0, ge=0.05, le=16, description="pixels of the panorama per pixel of the reference frame")
    reference: Literal["first", "middle", "last"] | Annotated[int, Field(ge=0)] = Field(
        "middle", description="the frame in whose plane the panorama lies: first, middle, last, or a frame index"
    )
    extent: Extent = Field(
        "panorama",
        description="what panorama.tiff holds: panorama for every frame, reference for the reference frame (a stabilised "
        "image), or a box [x0, y0, x1, y1] in pixels of the reference frame: columns x0 to x1 - 1 and rows y0 to y1 - 1. On a "
        "cylinder or a sphere the box is in degrees: to the right and down from where the reference camera looks",
    )
    projection: Literal["auto", ProjectionName] = Field(
        "auto",
        description="on what the panorama is drawn. If the camera only turns, auto takes a plane for up to 90 degrees, then a "
        "cylinder for up to 45 degrees up and down, then a sphere; otherwise it is a plane. mercator and stereographic keep "
        "angles, panini keeps what is upright and what leads ahead straight; both of the latter hold up to 150 degrees aside",
    )
    horizon: Literal["reference", "level"] = Field(
        "reference",
        description="where the horizon of a cylinder or a sphere lies: in the middle of the reference camera's view, as it was "
        "held, or level along the whole motion",
    )
    movers: Literal["hide", "show", "action"] | Annotated[int, Field(ge=0)] = Field(
        "hide",
        description="what hides the background for a time, since it moves by itself or is near: hide leaves it out of the "
        "panorama, as far as the background was ever seen, and show merges all photons; action shows it several times along "
        "its way, and a frame index as it was at that frame",
    )
    tolerance_px: float = Field(
        0.125,
        gt=0,
        le=8,
        description="motion, in px of a frame, within which frames are summed before they are warped; 0.25 takes half "
        "the time of 0.125, and costs 0.07 dB for a sharp scene in good light",
    )
    white_quantile: float = Field(0.995, gt=0, le=1, description="quantile of the flux that is white in panorama.png")
    white_balance: Literal["none", "grey-world"] | tuple[_Factor, _Factor, _Factor] = Field(
        "none",
        description="factors of red, green and blue in panorama.png, for a capture in colour: those that make the mean grey, "
        "or [red, green, blue]; panorama.tiff stays as it was measured",
    )
    tone: Literal["srgb", "reinhard", "drago", "mantiuk", "local"] = Field(
        "srgb",
        description="how flux becomes panorama.png: srgb shows it as it is up to white_quantile; the others compress a large "
        "range: reinhard, drago and mantiuk with OpenCV, and local by regions, which keeps the details of dark and bright ones",
    )
    exposure_stops: float = Field(
        0.0, ge=-20, le=20, description="how much brighter panorama.png is, in powers of two; 1 is twice as bright"
    )

    @field_validator("extent", mode="after")
    @classmethod
    def _has_pixels(cls, extent: Extent) -> Extent:
        if not isinstance(extent, str) and (extent[2] <= extent[0] or extent[3] <= extent[1]):
            raise ValueError(f"expected [x0, y0, x1, y1] with x0 < x1 and y0 < y1, got {list(extent)}")
        return extent


class OutputSettings(Config):
    """The run folder."""

    directory: SpecPath = Field(
        description="the run folder; by default `runs/` and the name of the spec, beside the spec; the name of the capture "
        "follows if `--set` chooses one"
    )
    exposures: bool = Field(
        False,
        description="of a run without a panorama: whether its exposures are written, as pictures in images/",
    )
    keep: Literal["exposures", "halves"] | None = Field(
        None,
        description="exposures writes the exposures of each level of a panorama into exposures/: linear flux, and pictures; "
        "each level is merged once more for that. halves writes panorama-first.tiff and panorama-last.tiff, of the first and "
        "the last half of the frames that saw each place, which are merged once more, and finds the real detail at this scale",
    )


class RunSettings(Config):
    """How the run uses the machine."""

    seed: int = Field(0, ge=0, description="seed of all randomness in the run")
    threads: Literal["auto"] | Annotated[int, Field(ge=1, le=1024)] = Field(
        "auto", description="number of threads; auto takes one per core"
    )
    memory: ByteSize = Field(
        ByteSize(2 * 1024**3),
        ge=64 * 1024**2,
        description="memory for rendering the panorama; a larger panorama is rendered in parts, and one of more than "
        "16 times this size is an error",
    )
    time_limit: float | None = Field(
        None,
        gt=0,
        description="seconds after which no further level, correction or refinement of the motion begins: the panorama is made "
        "along the motion that is known by then, and a warning says what was left out; none without it",
    )


VERSION = 1
LEVELS = 3
MAX_LEVELS = 8
# Instead of a number of levels: as many as the motion needs to converge, `MAX_LEVELS` at most.
UNTIL_CONVERGED = "until-converged"
# The sections that choose the components of a level, in the order of the loop.
STAGES = tuple(kind.section for kind in KINDS.values() if kind.of_level)
# The framework's own sections.
SETTINGS: dict[str, type[BaseModel]] = {
    "motion": MotionSettings,
    "camera": CameraSettings,
    "light": LightSettings,
    "graph": GraphSettings,
    "render": RenderSettings,
    "output": OutputSettings,
    "run": RunSettings,
}
# The keys that choose a component; and those of the framework's own sections that do.
CHOICE = ("use", "with")
NOT_SETTINGS = {"render": CHOICE, "output": ("formats",), "run": ("executor",)}
# The sections of a spec, in the order in which they are written; each kind of run that a plugin offers adds its own.
SECTIONS = ("version", "source", "corrections", *STAGES, "refine", "levels", *SETTINGS)
# The sections that do not apply to a run that finds something else than a panorama.
PANORAMA_ONLY = (*STAGES, "refine", "levels", "motion", "light", "graph", "render")
