from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

from photonpano.geometry import canvas_of, normalised, rescaling, transform_points, translation

FRAME_SHAPE = (60, 90)


@pytest.fixture(scope="session")
def frame_shape() -> tuple[int, int]:
    return FRAME_SHAPE


def panning_camera(n_frames: int) -> np.ndarray:
    """Return the homographies of a camera that pans and tilts: frame pixels to pixels of a scene, at its true scale."""
    height, width = FRAME_SHAPE
    camera = np.array([[300.0, 0, (width - 1) / 2], [0, 300.0, (height - 1) / 2], [0, 0, 1]])
    time = np.linspace(-1, 1, n_frames) if n_frames > 1 else np.zeros(1)
    maps = []
    for t in time:
        yaw, pitch = 0.2 * t, 0.02 * np.sin(4 * t)
        turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        nod = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
        maps.append(translation(100, 40) @ camera @ turn @ nod @ np.linalg.inv(camera))
    return normalised(np.array(maps))


@pytest.fixture(scope="session")
def true_motion() -> np.ndarray:
    return panning_camera(120)


def flux_at(points: np.ndarray) -> np.ndarray:
    """Return a smooth flux at points (..., 2) of the scene plane."""
    x, y = points[..., 0], points[..., 1]
    return (0.5 + 0.3 * np.sin(x / 9) * np.cos(y / 7)).astype(np.float32)


@pytest.fixture
def capture(tmp_path: Path, true_motion: np.ndarray) -> SimpleNamespace:
    """Write a perfect run, its plane in another gauge and its canvas at scale 2, and the truth of the capture."""
    gauge = rescaling(1.25) @ translation(-70, 15)
    estimated = normalised(gauge @ true_motion)
    canvas = canvas_of(estimated, FRAME_SHAPE, 2.0)
    x, y = np.meshgrid(np.arange(canvas.width), np.arange(canvas.height))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    on_canvas = transform_points(np.linalg.inv(canvas.transform @ gauge), pixels).reshape(*canvas.shape, 2)
    flux = flux_at(on_canvas)
    weight = np.zeros(canvas.shape, dtype=np.float32)
    weight[20:-20, 20:-20] = 50
    flux[weight == 0] = np.nan

    folder = tmp_path / "run"
    folder.mkdir()
    capture = SimpleNamespace(
        folder=folder,
        truth=tmp_path / "truth.npz",
        gauge=gauge,
        canvas=canvas,
        flux=flux,
        weight=weight,
        trajectory={
            "homographies": estimated,
            "canvas": canvas.transform,
            "frame_shape": np.array(FRAME_SHAPE),
            "reference": np.array(60),
            "located": np.ones(len(estimated), dtype=bool),
            "std_px": np.full(len(estimated), 0.5),
        },
        true={
            "homographies": true_motion,
            "frame_shape": np.array(FRAME_SHAPE),
            "scene": flux_at(np.stack(np.meshgrid(np.arange(300), np.arange(150)), axis=-1)),
        },
    )
    capture.write = lambda: _write(capture)
    capture.write()
    return capture


def _write(capture: SimpleNamespace) -> None:
    np.savez(capture.folder / "trajectory.npz", **capture.trajectory)
    tifffile.imwrite(capture.folder / "panorama.tiff", capture.flux)
    tifffile.imwrite(capture.folder / "coverage.tiff", capture.weight)
    np.savez(capture.truth, **capture.true)
