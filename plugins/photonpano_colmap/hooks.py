"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator

import photonpano_colmap as plugin
from photonpano import LocatorContribution, PoseEstimatorContribution, Requirement, StreamInfo, hookimpl
from photonpano_colmap.configs import ColmapAveragesConfig, PycolmapTwoViewConfig, StratifiedPoseConfig, too_few_averages

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
