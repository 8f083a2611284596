"""Read what evaluation compares: the files of a run folder, and the truth of a simulated capture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.evaluation.scores import Turn
from photonpano.geometry import (
    PROJECTIONS,
    Camera,
    Canvas,
    corners,
    nearest_rotations,
    normalised,
    transform_points,
    translation,
)
from photonpano.notebooks import facts
from photonpano.plugins.contributions import RunKindContribution
from photonpano.plugins.registry import discover
from photonpano.reading import read_arrays, reading
from photonpano.text import pixels
from photonpano.values import BoolArray, FloatArray, FluxImage, Homography

_TRUTH = "a truth as `photonpano simulate` writes it"


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """True motion and scene of a simulated capture."""

    # (T, 3, 3), frame pixels to pixels of the scene; exact at the corners of the frame if the lens distorts
    homographies: FloatArray
    frame_shape: tuple[int, int]
    # (H, W) float32, photons per pixel per frame; (H, W, 3) of red, green and blue pixels; None if only the motion is known
    scene: FluxImage | None
    ideal_homographies: FloatArray  # (T, 3, 3), those of a lens without distortion
    turn: Turn | None = None
    # whether the scene is an equirectangular panorama, 360 degrees wide; homographies then map to pixels of the camera that
    # looks at its middle
    around: bool = False
    path: Path = Path("the truth")  # of the file, for messages


@dataclass(frozen=True, slots=True, eq=False)
class RunTrajectory:
    """Content of `trajectory.npz` in a run folder.

    Attributes:
        homographies: (T, 3, 3), frame pixels to reference pixels; ideal pixels of the frame if the lens of `camera` distorts.
        canvas: (3, 3), reference pixels to panorama pixels; (a, b, 1) to panorama pixels unless the projection is planar.
        frame_shape: (height, width) of a frame.
        located: (T,), False where a frame lies outside what was located.
        std_px: (T,) expected corner error; NaN if the run did not record it.
        camera: that turns; None if the run knows homographies only.
        projection: of the panorama.
        horizon: (3, 3) of the canvas; None for none.
    """

    homographies: FloatArray
    canvas: Homography
    frame_shape: tuple[int, int]
    located: BoolArray
    std_px: FloatArray
    camera: Camera | None = None
    projection: str = "planar"
    horizon: FloatArray | None = None

    def canvas_of(self, shape: tuple[int, int]) -> Canvas:
        """Return the canvas of the panorama, whose (height, width) is known."""
        matrix = None if self.camera is None or self.projection == "planar" else self.camera.matrix
        return Canvas(*shape, self.canvas, self.projection, matrix, self.horizon)

    @property
    def corner_homographies(self) -> FloatArray:
        """(T, 3, 3), pixels of a frame to reference pixels, exact at the corners of the frame if the lens distorts."""
        return self.homographies if self.camera is None else self.homographies @ self.camera.ideal_at_corners(self.frame_shape)

    @property
    def turn(self) -> Turn | None:
        """Rotations and camera; None if the run knows homographies only."""
        if self.camera is None:
            return None
        return Turn(nearest_rotations(self.camera.rotations(self.homographies)), self.camera)

    def _repr_html_(self) -> str:
        return drawn_path(self.homographies[self.located], self.frame_shape) + facts(self._rows())

    def _rows(self) -> Iterator[tuple[str, str]]:
        located = self.located
        yield "frames", f"{located.sum():,} of {len(located):,} located"
        if np.isfinite(self.std_px[located]).any():
            std = self.std_px[located]
            yield (
                "expected error",
                f"{pixels(float(np.nanmean(std)))} px, and {pixels(float(np.nanmax(std)))} px in the worst frame",
            )
        if self.camera is not None:
            yield "camera", f"turns; focal length {self.camera.focal_px:,.0f} px"


def load_truth(path: Path) -> Truth:
    """Read the truth of a simulated capture; `InputError` if the file is no such archive.

    The file is an `.npz` archive of `homographies`, `frame_shape` and, for image scores, `scene`. If the lens distorts,
    `homographies` are those of an ideal lens, and `undistorted_corners` (4, 2) are its pixels of the frame's corners.
    """
    optional = ("scene", "undistorted_corners", "rotations", "camera_matrix", "distortion")
    if not read_arrays(path, _TRUTH, ("homographies",)):
        others = {kind.truth: kind for kind in discover().run_kinds.values()}
        for held in read_arrays(path, _TRUTH, others):
            what, section = others[held].name, others[held].section
            raise InputError(f"{path} is a truth with {what} and no homographies; score a run with `{section}` by it")
    arrays = read_numbers(path, _TRUTH, ("homographies", "frame_shape"), optional)
    scene = arrays.get("scene")
    frame_shape, homographies = frame_shape_of(path, arrays), _homographies(path, arrays)
    return Truth(
        homographies=homographies @ _lens(path, arrays, frame_shape),
        frame_shape=frame_shape,
        scene=None if scene is None else _scene(path, scene),
        ideal_homographies=homographies,
        turn=_turn(path, arrays),
        around=str(arrays.get("scene_projection", "planar")) == "spherical",
        path=path,
    )


def kind_of_run(folder: Path) -> RunKindContribution | None:
    """Return the kind of the run in a folder; None if it is a run for a panorama."""
    return next((kind for kind in discover().run_kinds.values() if (folder / kind.file).exists()), None)


def load_run_trajectory(folder: Path) -> RunTrajectory:
    """Read the trajectory of a run folder; `InputError` if the file is missing or damaged."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; give the run folder that `photonpano run` wrote")
    path = folder / "trajectory.npz"
    if not path.exists():
        if (kind := kind_of_run(folder)) is not None:
            raise InputError(
                f"{folder} is a run with `{kind.section}`: it has {kind.name}, and neither homographies nor a panorama"
            )
        raise InputError(f"{folder} has no trajectory.npz, so no run has finished in it; give the folder of a finished run")
    required = ("homographies", "canvas", "frame_shape", "located", "std_px")
    arrays = read_numbers(path, "the trajectory of a run", required, ("camera_matrix", "distortion", "horizon"))
    homographies = _homographies(path, arrays)
    canvas, located, std_px = (arrays[name] for name in ("canvas", "located", "std_px"))
    if canvas.shape != (3, 3):
        raise InputError(f"{path}: canvas must have the shape (3, 3), got {canvas.shape}")
    if not np.isfinite(canvas).all() or not np.linalg.det(canvas):
        raise InputError(f"{path}: canvas must be finite and invertible")
    if located.shape != (len(homographies),):
        raise InputError(f"{path}: located must have a flag for each of {len(homographies)} frames, got {located.shape}")
    if std_px.shape != (len(homographies),):
        raise InputError(f"{path}: std_px must have a number for each of {len(homographies)} frames, got {std_px.shape}")
    camera, projection = _camera(path, arrays), str(arrays.get("projection", "planar"))
    if projection not in PROJECTIONS or (projection != "planar" and camera is None):
        raise InputError(f"{path}: the projection {projection} is not known, or lacks its camera_matrix")
    return RunTrajectory(
        homographies=homographies,
        canvas=canvas.astype(np.float64),
        frame_shape=frame_shape_of(path, arrays),
        located=located.astype(bool),
        std_px=std_px.astype(np.float64),
        camera=camera,
        projection=projection,
        horizon=arrays.get("horizon"),
    )


def load_panorama(folder: Path) -> tuple[FluxImage, FluxImage]:
    """Read flux and weight, (H, W) or (H, W, 3) each, of the panorama of a run folder.

    Raises an `InputError` if a file is missing or damaged, or the two differ in size.
    """
    flux, weight = (read_tiff(folder / name) for name in ("panorama.tiff", "coverage.tiff"))
    if flux.ndim < 2 or flux.shape[2:] not in ((), (3,)) or flux.shape != weight.shape:
        raise InputError(
            f"{folder}: panorama.tiff and coverage.tiff must be images of one size, "
            f"got the shapes {flux.shape} and {weight.shape}"
        )
    return flux, weight


def read_tiff(path: Path) -> FluxImage:
    """Read an image of float32; `InputError` if it is missing or damaged."""
    import tifffile

    if not path.exists():
        raise InputError(f"{path} is missing, so the run folder is incomplete; run the spec again")
    with reading(path, "cannot be read as a TIFF image: it is damaged; run the spec again"):
        return np.asarray(tifffile.imread(path), dtype=np.float32)


def read_numbers(path: Path, content: str, required: tuple[str, ...], optional: tuple[str, ...]) -> Mapping[str, NDArray[Any]]:
    """Read an archive of named arrays, and nothing from pickles; `InputError` if one is missing, or has no numbers."""
    arrays = read_arrays(path, content)
    missing = [name for name in required if name not in arrays]
    if missing:
        held = ", ".join(name or "an array without a name" for name in arrays) or "nothing"
        raise InputError(
            f"{path} lacks {' and '.join(missing)}; {content} contains {', '.join((*required, *optional))}; "
            f"this file contains {held}"
        )
    for name in (*required, *optional):
        if name in arrays and arrays[name].dtype.kind not in "biuf":
            raise InputError(f"{path}: {name} must contain numbers")
    return arrays


def _scene(path: Path, scene: NDArray[Any]) -> FluxImage:
    """Return the true flux (H, W); NaN where it is unknown."""
    if scene.ndim < 2 or scene.shape[2:] not in ((), (3,)) or not scene.size:
        raise InputError(f"{path}: scene must be an image (height, width) or (height, width, 3), got the shape {scene.shape}")
    with np.errstate(over="ignore"):
        flux = scene.astype(np.float32, copy=False)
    if np.isinf(flux).any():
        raise InputError(f"{path}: scene must be finite, or NaN where it is unknown")
    return flux


def _homographies(path: Path, arrays: Mapping[str, NDArray[Any]]) -> FloatArray:
    homographies = arrays["homographies"]
    if homographies.ndim != 3 or homographies.shape[1:] != (3, 3) or not len(homographies):
        raise InputError(f"{path}: homographies must have the shape (frames, 3, 3), got {homographies.shape}")
    try:
        # Those of a camera that turns by more than 90 degrees have another h33.
        turns = "camera_matrix" in arrays and np.isfinite(homographies).all()
        homographies = homographies.astype(np.float64) if turns else normalised(homographies)
        np.linalg.inv(homographies)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path}: homographies must be finite and invertible") from error
    return homographies


def _turn(path: Path, arrays: Mapping[str, NDArray[Any]]) -> Turn | None:
    """Return the rotations and the camera of a truth that has them."""
    camera = _camera(path, arrays)
    if camera is None or "rotations" not in arrays:
        return None
    rotations = arrays["rotations"].astype(np.float64)
    if rotations.shape != arrays["homographies"].shape or not np.isfinite(rotations).all():
        raise InputError(f"{path}: rotations must be finite and of the shape of homographies, got {rotations.shape}")
    return Turn(rotations, camera)


def _camera(path: Path, arrays: Mapping[str, NDArray[Any]]) -> Camera | None:
    """Return the camera of a motion that has one; another model of the lens, of two numbers, counts as none."""
    if "camera_matrix" not in arrays:
        return None
    matrix, distortion = arrays["camera_matrix"].astype(np.float64), arrays.get("distortion", np.zeros(4)).astype(np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.linalg.det(matrix):
        raise InputError(f"{path}: camera_matrix must be finite and invertible, of the shape (3, 3)")
    if distortion.shape not in ((2,), (4,)) or not np.isfinite(distortion).all():
        raise InputError(f"{path}: distortion must be finite, k1, k2, p1 and p2, got {distortion.tolist()}")
    return Camera(matrix, distortion if len(distortion) == 4 else np.zeros(4))


def _lens(path: Path, arrays: Mapping[str, NDArray[Any]], frame_shape: tuple[int, int]) -> Homography:
    """Return what the lens does to the corners of the frame, a scaling about its middle."""
    if "undistorted_corners" not in arrays:
        return np.eye(3)
    undistorted, distorted = arrays["undistorted_corners"], corners(frame_shape)
    if undistorted.shape != (4, 2) or not np.isfinite(undistorted).all():
        raise InputError(f"{path}: undistorted_corners must be four finite points (x, y), got {undistorted.tolist()}")
    middle = distorted.mean(axis=0)
    scale = np.linalg.norm(undistorted - middle) / np.linalg.norm(distorted - middle)
    return translation(*middle) @ np.diag([scale, scale, 1.0]) @ translation(*-middle)


def frame_shape_of(path: Path, arrays: Mapping[str, NDArray[Any]]) -> tuple[int, int]:
    """Return (height, width) of the frames of an archive; `InputError` if it is none."""
    shape = arrays["frame_shape"]
    if shape.shape != (2,) or shape.dtype.kind not in "iu" or shape.min() < 1:
        raise InputError(f"{path}: frame_shape must be two positive integers (height, width), got {shape.tolist()}")
    height, width = shape.tolist()
    return height, width


_MAX_POINTS = 500
_MAX_SIDE = 100  # maximum longer side of a drawing, in sides of a frame; a camera that rotates further leaves the plane


def drawn_path(homographies: FloatArray, frame_shape: tuple[int, int]) -> str:
    """Return the path of the middle of the frame over the reference plane, with the outlines of the first and last frame.

    The homographies are (N, 3, 3) of the located frames. The SVG element takes the colour of the text around it; it is empty
    where the path goes out of the plane.
    """
    if not len(homographies):
        return ""
    some = homographies[np.linspace(0, len(homographies) - 1, min(len(homographies), _MAX_POINTS)).round().astype(int)]
    outline = corners(frame_shape)
    middles = transform_points(some, np.broadcast_to(outline.mean(axis=0), (len(some), 1, 2)))[:, 0]
    outlines = transform_points(some[[0, -1]], np.broadcast_to(outline, (2, *outline.shape)))
    points = np.concatenate([middles, outlines.reshape(-1, 2)])
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    if not np.isfinite(points).all() or size.max() > _MAX_SIDE * max(frame_shape):
        return ""
    width, height = size.tolist()
    polygons = "".join(f'<polygon points="{_points(each)}" stroke-opacity="0.4"/>' for each in outlines)
    margin = 0.02 * max(width, height)
    box = f"{low[0] - margin:.1f} {low[1] - margin:.1f} {width + 2 * margin:.1f} {height + 2 * margin:.1f}"
    return (
        f'<svg viewBox="{box}" width="480" style="max-width:100%" fill="none" stroke="currentColor" '
        f'stroke-width="{max(width, height) / 240:.3g}" role="img" aria-label="the path of the camera">'
        f'{polygons}<polyline points="{_points(middles)}"/></svg>'
    )


def _points(points: FloatArray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
