"""What a report is made from: the content of `run.json`, and the arrays of the run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from photonpano.values import BoolArray, FloatArray, FluxImage, Homography


class SourceRecord(TypedDict):
    """The capture."""

    n_frames: int
    height: int
    width: int
    frame_rate_hz: float | None
    kind: str


class PluginRecord(TypedDict):
    """Who provided a stage: the component's name, its distribution and version."""

    stage: str
    use: str
    plugin: str
    version: str


class FailureRecord(TypedDict):
    """A pair that was not located. `moving` and `fixed` are half-open frame spans [start, stop)."""

    moving: Sequence[int]
    fixed: Sequence[int]
    reason: str


class LevelRecord(TypedDict):
    """One level.

    `groups` and `located` count virtual exposures, `pairs` and `failures` pairs of them; `located_by` counts pairs by locator.
    `revisits` counts, as `pairs` and `located`, pairs that may see one place at different times; `contradictions` are located
    pairs that were dropped because the others outvote them. `change_px` is how far the level moved the corners of the frames,
    None at the first level; `std_px` is how far the photons leave them open. `seconds` has an entry for each stage.
    """

    level: int
    scale: float
    groups: int
    group_frames: int
    pairs: int
    located: int
    located_by: Mapping[str, int]
    failures: Sequence[FailureRecord]
    revisits: Mapping[str, int]
    contradictions: Sequence[Mapping[str, Sequence[int]]]
    change_px: float | None
    std_px: float | None
    residual_px: float | None
    seconds: Mapping[str, float]


class MotionRecord(TypedDict):
    """The expected corner error of the located frames, in px: its mean, the largest, and the frame that has it."""

    std_px: float
    worst_std_px: float
    worst_frame: int


class DecisionRecord(TypedDict):
    """Something that the spec left open, what was chosen, and why."""

    what: str
    value: bool | int | float | str
    reason: str


class PanoramaRecord(TypedDict):
    """The panorama; `coverage_share` is the share of its pixels that was seen, `white_flux` what is white in the PNG.

    The PNG is smaller than the panorama by `picture_reduction`, where that was rendered in parts.
    """

    height: int
    width: int
    scale: float
    picture_reduction: int
    white_flux: float
    coverage_share: float
    seconds: float


class RunRecord(TypedDict):
    """The content of `run.json`.

    `created` is an ISO 8601 time; `motion` and `panorama` are None for a run that did not get so far.
    """

    photonpano: str
    status: str
    created: str
    spec: Mapping[str, Any]
    spec_file: str | None
    seed: int
    source: SourceRecord
    plugins: Sequence[PluginRecord]
    libraries: Mapping[str, str]
    decisions: Sequence[DecisionRecord]
    levels: Sequence[LevelRecord]
    motion: MotionRecord | None
    panorama: PanoramaRecord | None
    warnings: Sequence[str]
    seconds: float
    peak_memory_bytes: int


@dataclass(frozen=True, slots=True, eq=False)
class RunArrays:
    """The arrays that the figures show.

    Convention:
        Points are (x, y), integers are pixel centres; homographies map frame pixels to reference pixels.

    Attributes:
        preview: (H, W) or (H, W, 3) uint8, the panorama as `panorama.png` shows it.
        coverage: (H, W) float32, how many frames each pixel was seen in.
        homographies: (T, 3, 3) the trajectory.
        located: (T,) False where a frame lies outside what was located.
        std_px: (T,) the expected corner error, infinite where a frame lies outside what was located.
        canvas: (3, 3), reference pixels to panorama pixels.
        frame_shape: (height, width) of a frame.
        reference: the frame whose homography is the identity.
    """

    preview: NDArray[np.uint8]
    coverage: FluxImage
    homographies: FloatArray
    located: BoolArray
    std_px: FloatArray
    canvas: Homography
    frame_shape: tuple[int, int]
    reference: int
