"""Which of the frames that the camera takes are in the capture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano_simulator.config import SimulationConfig


def delivered(config: SimulationConfig) -> NDArray[np.int64]:
    """Return, for each frame of the capture, the index of the frame that the camera took.

    Raises:
        InputError: a range lies beyond the last frame, or no frame is left.
    """
    for key, ranges in (("drops", config.drops), ("repeats", config.repeats)):
        for each in ranges:
            if each.at + each.frames > config.n_frames:
                raise InputError(
                    f"{key} names the frames {each.at} to {each.at + each.frames - 1}, but the camera takes {config.n_frames} "
                    f"frames (0 to {config.n_frames - 1}); shorten the range, or raise n_frames"
                )
    # A repeated range follows its own last frame: a stable sort by where a frame comes puts it there.
    taken = [np.arange(config.n_frames), *(np.arange(each.at, each.at + each.frames) for each in config.repeats)]
    places = [np.arange(config.n_frames), *(np.full(each.frames, each.at + each.frames - 1) for each in config.repeats)]
    order = np.concatenate(taken)[np.argsort(np.concatenate(places), kind="stable")]
    kept = np.ones(config.n_frames, dtype=bool)
    for each in config.drops:
        kept[each.at : each.at + each.frames] = False
    if not kept.any():
        raise InputError(f"drops leaves none of the {config.n_frames} frames; drop fewer of them")
    return order[kept[order]]
