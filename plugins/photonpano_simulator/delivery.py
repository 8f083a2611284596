"""Which of the frames that the camera takes are in the capture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano_simulator.recording import FrameRange


def delivered(n_frames: int, drops: tuple[FrameRange, ...], repeats: tuple[FrameRange, ...]) -> NDArray[np.int64]:
    """Return, for each frame of the capture, the index of the frame that the camera took.

    Args:
        n_frames: frames that the camera takes.
        drops: frames that are missing in the capture.
        repeats: frames that the capture holds twice.

    Raises:
        InputError: a range lies beyond the last frame, or no frame is left.
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
