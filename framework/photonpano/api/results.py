"""Read panorama and motion of a finished run."""

from __future__ import annotations

from pathlib import Path

from photonpano.evaluation import RunTrajectory, load_run_trajectory
from photonpano.evaluation import load_panorama as read_panorama
from photonpano.record.contents import require_one_run
from photonpano.values import Panorama


def load_panorama(run_folder: Path | str) -> Panorama:
    """Read the panorama of a finished run: flux, weight and canvas.

    Args:
        run_folder: written by `run` or `render`.

    Raises:
        InputError: the folder is no run folder, or a file is missing or damaged.
    """
    folder = Path(run_folder)
    require_one_run(folder, ["trajectory.npz", "panorama.tiff", "coverage.tiff"])
    canvas = load_run_trajectory(folder, needs_std_px=False).canvas
    return Panorama(*read_panorama(folder), canvas)


def load_trajectory(run_folder: Path | str) -> RunTrajectory:
    """Read the motion of a finished run: the homography of every frame, with its expected error.

    Args:
        run_folder: written by `run` or `render`.

    Raises:
        InputError: the folder is no run folder, or the file is missing or damaged.
    """
    folder = Path(run_folder)
    require_one_run(folder, ["trajectory.npz"])
    return load_run_trajectory(folder, needs_std_px=False)
