"""Merger `short-exposure`: sum only the frames during which the camera hardly moved."""

import numpy as np

from photonpano import FrameSpan, Group, Source, Trajectory, VirtualExposure
from photonpano.geometry import corner_displacements, inverse, rescaling
from photonpano.merging import Chunk, accumulate


class ShortExposure:
    """Shortens a group until the camera stands nearly still, as a photographer does: noise instead of blur."""

    def __init__(self, max_motion_px: float) -> None:
        self.max_motion_px = max_motion_px

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge the steady part of a group; see `photonpano.Merger`."""
        span = group.span
        if trajectory is not None:  # at the first level there is none, and all frames count
            span = steady_part(group, trajectory, source.info.frame_shape, self.max_motion_px)
        height, width = source.info.frame_shape
        shape = round(height * scale), round(width * scale)
        photons = accumulate(source, [Chunk(span, np.eye(3))], rescaling(scale), shape)
        flux, weight = photons.estimate(source.response)
        return VirtualExposure(flux, weight, group, scale, source.response)


def steady_part(group: Group, trajectory: Trajectory, frame_shape: tuple[int, int], max_motion_px: float) -> FrameSpan:
    """Return the frames around the reference instant during which no corner moves too far.

    Args:
        group: the frames to choose from, and the reference instant.
        trajectory: the motion known so far.
        frame_shape: (height, width) of a frame.
        max_motion_px: largest distance of a corner from its place at the reference instant, in px.
    """
    frames = np.arange(group.span.start, group.span.stop)
    to_reference = inverse(trajectory.at([group.reference])[0]) @ trajectory.at(frames)
    moved = corner_displacements(to_reference, np.eye(3), frame_shape).max(axis=-1) > max_motion_px
    moved[np.abs(frames - group.reference).argmin()] = False  # one frame is always left
    too_early, too_late = (frames[moved & side] for side in (frames < group.reference, frames > group.reference))
    start = too_early[-1] + 1 if too_early.size else group.span.start
    stop = too_late[0] if too_late.size else group.span.stop
    return FrameSpan(int(start), int(stop))
