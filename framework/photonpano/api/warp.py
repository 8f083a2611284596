"""Warp the frames of a capture along a motion, for those who want nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.api.opened_run import load_trajectory
from photonpano.errors import InputError
from photonpano.geometry import inverse
from photonpano.values import FloatArray

if TYPE_CHECKING:
    from photonpano.evaluation import RunTrajectory


def warp(frames: Any, trajectory: RunTrajectory | NDArray[np.floating[Any]] | Path | str) -> Any:
    """Warp frames to the pixels of the reference frame, interpolated linearly: a stabilised film.

    To sum photons, take the panorama of a run: it interpolates once, where sums of warped frames blur.

    Args:
        frames: (T, H, W) or (T, H, W, C), numbers or flags; an array of numpy, or a tensor of torch.
        trajectory: the motion of these T frames: what `load_trajectory` returns, a run folder, or homographies (T, 3, 3) from
            pixels of a frame to pixels of the reference frame. That of a run knows the lens.

    Returns:
        float32 of the shape of the frames, NaN where a frame does not show a pixel. Of a tensor, a tensor on the same device,
        which can be differentiated by the frames.

    Raises:
        InputError: frames and motion do not belong together.
    """
    motion = load_trajectory(trajectory) if isinstance(trajectory, str | Path) else trajectory
    homographies = np.asarray(getattr(motion, "homographies", motion), np.float64)
    camera = getattr(motion, "camera", None)
    shape = tuple(frames.shape)
    if len(shape) not in (3, 4) or homographies.shape != (shape[0], 3, 3):
        raise InputError(
            f"warp takes frames (T, H, W) or (T, H, W, C) and a homography for each, (T, 3, 3); got the shapes {shape} and "
            f"{homographies.shape}. Give the frames of the whole run, or the homographies of a part of them"
        )
    known = getattr(motion, "frame_shape", shape[1:3])
    if tuple(known) != shape[1:3]:
        raise InputError(f"the motion is of frames of {known[0]}x{known[1]} px, and these have {shape[1]}x{shape[2]}")
    y, x = np.mgrid[: shape[1], : shape[2]].astype(np.float64)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    on_tensors = not isinstance(frames, np.ndarray)
    warped = []
    for frame, to_frame in zip(frames, inverse(homographies), strict=True):
        rays = pixels @ to_frame.T
        with np.errstate(divide="ignore", invalid="ignore"):
            places = np.where(rays[..., 2:] > 0, rays[..., :2] / rays[..., 2:], np.nan)
        if camera is not None and camera.distorts:
            places = camera.distorted(places)
        warped.append(_sampled_tensor(frame, places) if on_tensors else _sampled(frame, places))
    if not on_tensors:
        return np.stack(warped) if warped else np.zeros(shape, np.float32)
    import torch

    return torch.stack(warped) if warped else torch.zeros(shape)


def _seen(places: FloatArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    x, y = places[..., 0], places[..., 1]
    return np.asarray((x >= 0) & (y >= 0) & (x <= shape[1] - 1) & (y <= shape[0] - 1))


def _sampled(frame: NDArray[Any], places: FloatArray) -> NDArray[np.float32]:
    x, y = np.moveaxis(np.nan_to_num(places, nan=-1).astype(np.float32), -1, 0)
    image = cv2.remap(frame.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = _seen(places, frame.shape).reshape(places.shape[:2] + (1,) * (frame.ndim - 2))
    return np.asarray(np.where(seen, image.reshape(frame.shape), np.nan), np.float32)


def _sampled_tensor(frame: Any, places: FloatArray) -> Any:
    import torch
    from torch.nn.functional import grid_sample

    image = frame.float().reshape(*frame.shape[:2], -1).movedim(-1, 0)
    size = np.array([max(frame.shape[1] - 1, 1), max(frame.shape[0] - 1, 1)])
    grid = torch.as_tensor(2 * np.nan_to_num(places, nan=-1) / size - 1, dtype=torch.float32, device=frame.device)
    sampled = grid_sample(image[None], grid[None], padding_mode="border", align_corners=True)[0].movedim(0, -1)
    seen = torch.as_tensor(_seen(places, tuple(frame.shape)), device=frame.device)
    return torch.where(seen[..., None], sampled, torch.nan).reshape(frame.shape)
