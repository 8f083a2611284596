"""Projects of Hugin, whose formulas are written here again."""

import numpy as np
import pytest

from photonpano import InputError
from photonpano.geometry import Camera, Canvas, rotation_matrices
from photonpano_poses.files import Poses
from photonpano_poses.hugin import hugin, hugin_lens

SHAPE = (60, 90)
ROTATIONS = rotation_matrices(np.array([[0.1, -0.5, 0.2], [-0.15, 0.4, 0.05], [0.0, 0.0, 0.0]]))
HORIZON = rotation_matrices(np.array([[0.05, 0.0, -0.1]]))[0]
MATRIX = np.array([[80.0, 0, 46.0], [0, 80, 28.5], [0, 0, 1]])


def numbers(line: str) -> dict[str, str]:
    """Return the fields of a line of a project by their letters."""
    names = ("Ra", "Rb", "Rc", "Rd", "Re", "Va", "Vb", "Vc", "Vd", "Vx", "Vy", "Eev", "Er", "Eb")
    fields = (
        next(((name, word[len(name) :]) for name in names if word.startswith(name)), (word[0], word[1:]))
        for word in line.split()[1:]
    )
    return dict(fields)


def by_hugin(project: str, image: int, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project (N, 3) directions of Hugin's world (x right, y down, z ahead) to its panorama and to an image, from borders."""
    lines = project.splitlines()
    [panorama], images = ([numbers(line) for line in lines if line.startswith(kind)] for kind in ("p ", "i "))
    x, y, z = directions.T
    width, height, view = float(panorama["w"]), float(panorama["h"]), np.radians(float(panorama["v"]))
    left, _, top, _ = map(float, panorama["S"].split(","))
    across, down = {
        "0": (x / z, y / z),
        "1": (np.arctan2(x, z), y / np.hypot(x, z)),
        "2": (np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))),
    }[panorama["f"]]
    per_radian = width / 2 / np.tan(view / 2) if panorama["f"] == "0" else width / view
    on_panorama = np.stack([width / 2 + per_radian * across - left, height / 2 + per_radian * down - top], axis=-1)

    first, own = images[0], images[image]
    yaw, pitch, roll = (np.radians(float(own[key])) for key in "ypr")
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    spin = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    x, y, z = (directions @ (turn @ tilt @ spin)).T
    w, h, v, a, b, c, d, e = (float(first[key]) for key in "whvabcde")
    r = np.stack([x / z, y / z], axis=-1) * (w / 2 / np.tan(np.radians(v) / 2)) / (min(w, h) / 2)
    size = np.linalg.norm(r, axis=1, keepdims=True)
    seen = r * (a * size**3 + b * size**2 + c * size + 1 - a - b - c) * min(w, h) / 2
    return on_panorama, seen + np.array([w / 2 + d, h / 2 + e])


@pytest.mark.parametrize("projection", ["planar", "cylindrical", "spherical"])
@pytest.mark.parametrize("distortion", [(0, 0, 0, 0), (-0.1, 0.02, 0, 0)])
def test_hugin_puts_pixels_where_the_run_has_them(projection: str, distortion: tuple[float, ...]) -> None:
    camera = Camera(MATRIX, np.array(distortion, float))
    if projection == "planar":
        canvas = Canvas(170, 300, np.array([[2.0, 0, 150.5], [0, 2, 40], [0, 0, 1]]), camera_matrix=None)
    else:
        transform = np.array([[160.0, 0, 150.5], [0, 160, 82.5], [0, 0, 1]])
        canvas = Canvas(170, 320, transform, projection, camera.matrix, HORIZON)
    poses = Poses(
        camera=camera,
        frame_shape=SHAPE,
        names=("a.png", "b.png", "c.png"),
        rotations=ROTATIONS,
        seconds=np.zeros(3),
        canvas=canvas,
    )
    project = hugin(poses)["panorama.pto"]
    pixels = np.array([[5.0, 3], [80, 9], [44, 30], [12, 55], [85, 58]])
    ahead = np.eye(3)
    if projection != "planar":  # the middle column of the canvas is straight ahead
        middle = (159.5 - 150.5) / 160
        ahead = rotation_matrices(np.array([[0, -middle, 0]]))[0] @ HORIZON
    for image, rotation in enumerate(ROTATIONS):
        directions = camera.directions(pixels) @ rotation.T
        places, seen = by_hugin(project, image, directions @ ahead.T)
        ours = canvas.pixels(directions @ camera.matrix.T @ canvas.plane_to_rays.T)
        np.testing.assert_allclose(places - 0.5, ours, atol=1e-6)
        np.testing.assert_allclose(seen - 0.5, pixels, atol=0.02 if any(distortion) else 1e-9)


def test_the_residual_of_the_lens_has_its_tangential_distortion() -> None:
    radial = hugin_lens(Camera(MATRIX, np.array([-0.1, 0.02, 0, 0])), SHAPE)
    tangential = hugin_lens(Camera(MATRIX, np.array([-0.1, 0.02, 0.001, 0])), SHAPE)
    assert radial.shift_px == (1.5, -1.0)
    assert radial.residual_px < 0.02 < 0.04 < tangential.residual_px


def test_lens_that_folds_the_frame_over_is_refused() -> None:
    with pytest.raises(InputError, match="folds the image over within its frame, which Hugin cannot describe"):
        hugin_lens(Camera(MATRIX, np.array([-3.0, 0, 0, 0])), SHAPE)
