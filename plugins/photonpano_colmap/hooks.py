"""Configs and hooks of the plugin; light enough to be imported when plugins are listed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

import photonpano_colmap as plugin
from photonpano import Config, LocatorContribution, Requirement, StreamInfo, hookimpl
from photonpano.locating import KeypointConfig
from photonpano_poses import PoseEstimatorContribution

FIRST_CENTRE = 0.5  # position of the centre of the first pixel in COLMAP; ours is 0
SEEDS = 2**31  # seeds of the library are below this
MIN_AVERAGES = 5  # a spline through fewer poses would be a guess


def starts_of(n_frames: int, size: int, step: int | Literal["auto"]) -> list[int]:
    """Return the first frame of each average of `size` frames that lies in a capture."""
    if n_frames < size:
        return []
    if step != "auto":
        return list(range(0, n_frames - size + 1, step))
    # Side by side, and the last one ends with the capture.
    return [round(start) for start in np.linspace(0, n_frames - size, -(-n_frames // size))]


def counted(averages: int) -> str:
    """Return a number of averages in words."""
    return "1 average" if averages == 1 else f"{averages} averages"


def too_few_averages(n_frames: int, size: int, step: int | Literal["auto"]) -> str | None:
    """Return the problem if a capture gives too few averages of some frames."""
    averages = len(starts_of(n_frames, size, step))
    if averages >= MIN_AVERAGES:
        return None
    return (
        f"{n_frames} frames are {counted(averages)} of {size}; at least {MIN_AVERAGES} are needed: choose a smaller "
        "pose.with.group_size, or record longer"
    )


class PycolmapTwoViewConfig(KeypointConfig):
    """COLMAP's features and matches, LO-RANSAC, least squares."""

    max_keypoints: int = Field(
        2000,
        ge=16,
        le=32_768,
        description="number of keypoints kept of an exposure, the largest; the time of matching grows with its square",
    )
    peak_threshold: float = Field(
        0.0067, ge=0, le=1, description="keypoints with less contrast after a blur of 1 px are dropped; white is 1"
    )


class ColmapAveragesConfig(Config):
    """Averages of frames into COLMAP, and a spline through their poses."""

    group_size: Literal["auto"] | Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        "auto", description="number of frames that are averaged; auto chooses it by light and motion"
    )
    step: Literal["auto"] | Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        "auto", description="number of frames from one average to the next; auto takes group_size, side by side"
    )
    mapper: Literal["incremental", "global"] = Field(
        "incremental", description="how COLMAP finds poses: incremental adds one image after the other, global all at once"
    )
    matcher: Literal["exhaustive", "sequential"] = Field(
        "exhaustive",
        description="which averages are matched: exhaustive matches all pairs, and its time grows with the square of their "
        "number; sequential matches each with the 10 that follow",
    )
    max_keypoints: int = Field(4096, ge=64, le=32_768, description="number of keypoints of an average, at most")
    min_parallax_deg: float = Field(
        2.0,
        ge=0.1,
        le=60,
        description="smallest parallax, in degrees: the median angle between the views of a point that differ most; with less, "
        "there are no poses to rely on",
    )
    disconnected: Literal["error", "largest"] = Field(
        "error",
        description="if COLMAP finds several pieces whose poses are not connected: stop with an error that names them, or go "
        "on with the largest",
    )
    depth: bool = Field(
        False, description="find the depth of all pixels of up to 32 exposures, with its error, and dense points"
    )


class StratifiedPoseConfig(ColmapAveragesConfig):
    """Averages of frames into COLMAP; then exposures of the same frames, merged and located through the depth of the scene."""

    levels: int = Field(
        3,
        ge=2,
        le=8,
        description="number of levels, that of the averages included; each further one merges the groups anew, along the path "
        "and through the depth that the level before found; with depth, there is one more",
    )


_REQUIRES = (Requirement("pycolmap", "photonpano[colmap]"),)


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer the two-view geometry of COLMAP."""
    yield LocatorContribution(
        name="pycolmap-two-view",
        summary="COLMAP's SIFT and matcher, LO-RANSAC, and a least-squares fit of the inliers",
        config=PycolmapTwoViewConfig,
        build=lambda config, context: plugin.TwoViewLocator(config, context.seed),
        requires=_REQUIRES,
    )


@hookimpl
def photonpano_pose_estimators() -> Iterator[PoseEstimatorContribution]:
    """Offer the poses that COLMAP finds from averages of frames."""
    yield PoseEstimatorContribution(
        name="colmap-averages",
        summary="Averages of frames into COLMAP, and a spline through their poses (paper, section 6, Fig. 11)",
        config=ColmapAveragesConfig,
        build=lambda config, context: plugin.AveragesEstimator(config, context),
        check=_problems_of_averages,
        requires=_REQUIRES,
    )
    yield PoseEstimatorContribution(
        name="stratified-pose",
        summary="Exposures merged through the depth of the scene, without tremor, and located; begins with colmap-averages",
        config=StratifiedPoseConfig,
        build=lambda config, context: plugin.StratifiedEstimator(config, context),
        check=_problems_of_averages,
        requires=(*_REQUIRES, Requirement("gtsam", "photonpano[poses]")),
    )


def _problems_of_averages(config: ColmapAveragesConfig, stream: StreamInfo) -> list[str]:
    if config.group_size == "auto":
        return []
    problem = too_few_averages(stream.n_frames, config.group_size, config.step)
    return [problem] if problem else []
