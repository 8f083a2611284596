"""Hooks of the plugin; light enough to be imported when plugins are listed."""

from __future__ import annotations

from collections.abc import Iterator

import photonpano_poses as plugin
from photonpano import RunKindContribution, hookimpl


@hookimpl
def photonpano_run_kinds() -> Iterator[RunKindContribution]:
    """Offer runs that find poses."""
    yield RunKindContribution(
        name="poses",
        summary="The pose of each frame of a camera that travels through a scene",
        component=plugin.PoseEstimatorContribution,
        build=lambda *_: plugin.PoseRuns(),
        file="poses.npz",
        truth="camera_from_world",
    )
