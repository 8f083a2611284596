"""A catalog of toys that stand in for the first-party components, so that these tests need no plugin."""

from typing import Literal

import pytest
from pydantic import Field, model_validator

from photonpano import Config, Recognised, Requirement, SpecPath
from photonpano.plugins.contributions import KINDS
from photonpano.plugins.registry import Catalog, Origin, contributions_of, make_entry
from photonpano.specs import builtin


class PackedNpyConfig(Config):
    path: SpecPath = Field(description="the capture")
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second")


class Flip(Config):
    rows: bool = Field(False, description="upside down")


class Pan(Config):
    kind: Literal["pan"] = "pan"
    length_px: float = Field(300, gt=0, description="how far")


class Orbit(Config):
    kind: Literal["orbit"] = "orbit"
    radius_px: float = Field(100, gt=0, description="how wide")


class SimulatorConfig(Config):
    n_frames: int = Field(1000, ge=1, le=10_000_000, description="number of frames")
    flux: float = Field(0.5, gt=0, le=100, description="photons per pixel per frame")
    camera: Literal["pan", "loop"] = Field("pan", description="the path of the camera")
    size: tuple[int, int] = Field((254, 496), description="height and width in px")
    path: Pan | Orbit = Field(Pan(), discriminator="kind", description="the way of the camera")
    flip: Flip = Field(Flip(), description="turned frames")


class MidpointConfig(Config):
    group_size: int = Field(500, ge=1, description="frames of a group")
    stride: int = Field(1, ge=1, description="frames between groups")

    @model_validator(mode="after")
    def stride_within_group(self) -> "MidpointConfig":
        if self.stride > self.group_size:
            raise ValueError(f"stride ({self.stride}) must not exceed group_size ({self.group_size})")
        return self


class PhotonMleConfig(Config):
    kernel: Literal["linear", "cubic"] = Field("linear", description="how frames are warped")


class SiftConfig(Config):
    ratio: float = Field(0.8, gt=0, lt=1, description="of the nearest to the second match")
    max_keypoints: int = Field(4000, ge=10, description="the strongest are kept")


class DirectConfig(Config):
    max_steps: int = Field(30, ge=1, description="of the optimisation")


class LoftrConfig(Config):
    weights: SpecPath = Field(description="a local file")


class LucasKanadeConfig(Config):
    hold_frames: float = Field(0, ge=0, description="how long the velocity is held, in frames")


class SpansConfig(Config):
    span_frames: int = Field(8, ge=1, description="frames of a span")


class DriftConfig(Config):
    knots: int = Field(4, ge=2, description="of the spline")


class Plain(Config):
    """No keys."""


class SharpConfig(Config):
    rounds: int = Field(8, ge=1, le=99, description="number of rounds")


class MoodyConfig(Config):
    mood: str = ""

    @model_validator(mode="after")
    def raises(self) -> "MoodyConfig":
        raise RuntimeError("not today")


def unbuilt(config, context):
    raise AssertionError("nothing is built while a spec is read")


def toy(kind, name, config=Plain, **more):
    return KINDS[kind].contribution(name=name, summary="Toy", config=config, build=unbuilt, **more)


def missing_file(config):
    return [] if config.path.exists() else [f"there is no file {config.path.name}"]


def npy(path):
    return Recognised({"path": path}, "its name ends in .npy") if path.suffix == ".npy" else None


def too_few_spans(config, info):
    return [f"a capture of {info.n_frames} frames has no two spans"] if 2 * config.span_frames > info.n_frames else []


def too_small(config, info):
    return [f"{config.rounds} rounds are too many for frames of {info.height} rows"] if config.rounds > info.height else []


def too_few_frames(config, info):
    if config.group_size > info.n_frames:
        return [f"a group of {config.group_size} frames does not fit into the capture, which has {info.n_frames}"]
    return []


CONTRIBUTIONS = [
    *contributions_of(builtin),
    toy("source", "packed-npy", PackedNpyConfig, check=missing_file, recognise=npy),
    toy("source", "simulator", SimulatorConfig),
    toy("resampler", "midpoint", MidpointConfig, check=too_few_frames),
    toy("merger", "photon-mle", PhotonMleConfig),
    toy("locator", "opencv-sift", SiftConfig),
    toy("locator", "direct", DirectConfig),
    toy("locator", "kornia-loftr", LoftrConfig, requires=(Requirement("no_such_library", "photonpano[kornia]"),)),
    toy("locator", "moody", MoodyConfig),
    toy("interpolator", "smoothing-spline", LucasKanadeConfig),
    toy("interpolator", "lucas-kanade", LucasKanadeConfig),
    toy("refiner", "short-spans", SpansConfig, check=too_few_spans),
    toy("refiner", "drift", DriftConfig),
    toy("renderer", "merge"),
    toy("renderer", "sharp", SharpConfig, check=too_small),
]


def toys():
    rows = [make_entry(each, Origin("photonpano", "0.1.0", "toys = toys.hooks")) for each in CONTRIBUTIONS]
    twice = toy("locator", "twice", DirectConfig)
    rows += [make_entry(twice, Origin(plugin, "2.0", f"{plugin} = {plugin}.hooks")) for plugin in ("alpha", "beta")]
    return Catalog(tuple(rows))


@pytest.fixture(scope="session")
def catalog() -> Catalog:
    return toys()
