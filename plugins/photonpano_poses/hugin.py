"""Write pictures of a camera that only turns, with their directions, as a project of Hugin.

Convention:
    Yaw turns to the right, pitch up and roll clockwise, in degrees: a camera is rolled first, then pitched, then turned. Hugin
    measures from the outer borders of pixels, and distances from the middle of an image, or of a panorama. Its lens maps the
    distance r from the principal point to a r^4 + b r^3 + c r^2 + (1 - a - b - c) r, in units of half the shorter side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano import FloatArray, InputError
from photonpano.geometry import Camera
from photonpano_poses.files import Poses

_PROJECTIONS = {"planar": 0, "cylindrical": 1, "spherical": 2}


@dataclass(frozen=True, slots=True)
class HuginLens:
    """A lens as Hugin describes it."""

    view_degrees: float  # horizontal field of view without distortion
    radial: tuple[float, float, float]  # a, b and c
    shift_px: tuple[float, float]  # d and e, of the principal point from the middle of the image
    residual_px: float  # largest distance from the lens of the camera, in the frame


def hugin_lens(camera: Camera, frame_shape: tuple[int, int]) -> HuginLens:
    """Fit the lens of Hugin to a camera by least squares over its frame.

    Hugin's lens does not move a point at half the shorter side, which gives the focal length. It has no tangential distortion:
    that is part of the residual.

    Raises:
        InputError: the lens images nothing at half the shorter side.
    """
    height, width = frame_shape
    unit, centre = min(height, width) / 2, np.array(camera.centre_px)
    symmetric = Camera(camera.matrix, np.array([*camera.distortion[:2], 0.0, 0.0]))
    fixed_px = float(symmetric.ideal((centre[0] + unit, centre[1]))[0] - centre[0])
    if not np.isfinite(fixed_px):
        raise InputError("the lens of the run folds the image over within its frame, which Hugin cannot describe")
    y, x = np.mgrid[0 : height - 1 : 33j, 0 : width - 1 : 33j]
    frame = np.stack([x, y], axis=-1).reshape(-1, 2)
    ideal = camera.ideal(frame)
    frame, ideal = frame[np.isfinite(ideal[:, 0])], ideal[np.isfinite(ideal[:, 0])]
    # Radii without and with distortion.
    r = np.linalg.norm(ideal - centre, axis=1) / fixed_px
    seen = np.linalg.norm(symmetric.distorted(ideal) - centre, axis=1) / unit
    powers = np.stack([r**4, r**3, r**2], axis=1) - r[:, None]
    radial = np.linalg.lstsq(powers, seen - r, rcond=None)[0]
    stretch = 1 + (powers @ radial) / np.where(r > 0, r, 1)
    imaged = centre + (ideal - centre) * (stretch * unit / fixed_px)[:, None]
    a, b, c = radial.tolist()
    d, e = (centre + 0.5 - np.array([width, height]) / 2).tolist()
    view = 2 * np.degrees(np.arctan(width / 2 / (camera.focal_px * unit / fixed_px)))
    return HuginLens(float(view), (a, b, c), (d, e), float(np.linalg.norm(imaged - frame, axis=1).max()))


def hugin(poses: Poses) -> dict[str, str]:
    """Return a project of Hugin, whose panorama has the grid of that of the run.

    The middle of a panorama of Hugin is where it looks straight ahead: the canvas is cropped from a larger one. Its rows, and
    the columns of a plane, lie up to a quarter of a pixel beside those of the canvas, where its middle is at no half pixel.
    """
    from scipy.spatial.transform import Rotation

    canvas, camera, (height, width) = poses.canvas, poses.camera, poses.frame_shape
    assert canvas is not None
    if canvas.projection not in _PROJECTIONS:
        known = "planar, cylindrical or spherical"
        raise InputError(f"no project is written of a {canvas.projection} panorama; render it with render.projection: {known}")
    lens, to_world = hugin_lens(camera, poses.frame_shape), np.eye(3)
    per_radian = canvas.transform[0, 0] * (camera.focal_px if canvas.planar else 1)
    # Where the canvas looks straight ahead, from its border.
    ahead = (canvas.transform @ [*camera.centre_px, 1] if canvas.planar else canvas.transform[:, 2])[:2] + 0.5
    if not canvas.planar:  # the middle column is made to look ahead
        yaw = (canvas.width / 2 - ahead[0]) / per_radian
        to_world = Rotation.from_euler("y", -yaw).as_matrix() @ (np.eye(3) if canvas.horizon is None else canvas.horizon)
        ahead[0] = canvas.width / 2
    full = [max(1, round(2 * max(at, side - at))) for at, side in zip(ahead, (canvas.width, canvas.height), strict=True)]
    left, top = (round(whole / 2 - at) for whole, at in zip(full, ahead, strict=True))
    angle = 2 * np.arctan(full[0] / 2 / per_radian) if canvas.planar else full[0] / per_radian
    crop = f"S{left},{left + canvas.width},{top},{top + canvas.height}"
    a, b, c = lens.radial
    numbers = {"v": lens.view_degrees, "a": a, "b": b, "c": c, "d": lens.shift_px[0], "e": lens.shift_px[1]}
    response = {**dict.fromkeys(("Ra", "Rb", "Rc", "Rd", "Re"), 0), "Va": 1, **dict.fromkeys(("Vb", "Vc", "Vd", "Vx", "Vy"), 0)}
    lines = [
        "# hugin project file",
        f"# The lens is that of the run to {lens.residual_px:.2g} px.",
        f'p f{_PROJECTIONS[canvas.projection]} w{full[0]} h{full[1]} v{np.degrees(angle):.12g} {crop} E0 R0 n"TIFF_m c:LZW"',
        "m i0",
    ]
    for place, (name, angles) in enumerate(zip(poses.names, _yaw_pitch_roll(to_world @ poses.rotations), strict=True)):
        shared = numbers | response if not place else dict.fromkeys(numbers | response, "=0")  # all have the lens of the first
        of_lens = " ".join(f"{key}{value if isinstance(value, str) else f'{value:.12g}'}" for key, value in shared.items())
        turn = " ".join(f"{key}{angle:.12g}" for key, angle in zip("ypr", angles, strict=True))
        lines.append(f'i w{width} h{height} f0 {of_lens} {turn} Eev0 Er1 Eb1 n"images/{name}"')
    return {"panorama.pto": "\n".join([*lines, "v", ""])}


def _yaw_pitch_roll(rotations: FloatArray) -> FloatArray:
    """Return the angles of (N, 3, 3) rotations in degrees: (N, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_euler("YXZ", degrees=True))
