"""Tests of the canvas of a camera that turns: its projection, parts of it, and what is refused."""

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.geometry import Camera, Canvas, Extent, FrameTrajectory, rotation_matrices
from photonpano.merging.panorama import View, plan_canvas

SHAPE = (40, 60)
CAMERA = Camera.of(50.0, SHAPE)


def planned(
    degrees: float, projection: str = "auto", extent: Extent = "panorama", scale: float = 1.0, pitch: float = 0
) -> Canvas:
    """Return the canvas of a turn by some degrees, whose middle is the reference."""
    yaws = np.radians(np.linspace(-degrees / 2, degrees / 2, 81))
    turns = rotation_matrices(np.stack([0 * yaws, yaws, 0 * yaws], axis=-1)) @ rotation_matrices([np.radians(pitch), 0, 0])
    trajectory = FrameTrajectory(CAMERA.homographies(turns[40].T @ turns))
    view = View(projection, camera=CAMERA, turns=True)
    return plan_canvas(trajectory, FrameSpan(0, 81), SHAPE, scale, 2**30, extent=extent, view=view)


@pytest.mark.parametrize(
    ("degrees", "pitch", "projection"), [(20, 0, "planar"), (90, 0, "cylindrical"), (200, 60, "spherical")]
)
def test_auto_projection_follows_field_of_view(degrees: float, pitch: float, projection: str) -> None:
    assert planned(degrees, pitch=pitch).projection == projection


def test_box_in_degrees_is_that_part_of_the_panorama() -> None:
    whole = planned(360, "spherical", scale=2.0)
    part = planned(360, "spherical", (150, -10, 210, 15), scale=2.0)
    rays = np.array([[np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)] for a, b in np.radians([[151, -9], [179, 14]])])
    shift = part.pixels(rays) - whole.pixels(rays)
    assert np.allclose(shift, shift.round(), atol=1e-6)
    per_degree = part.period_px / 360
    assert part.shape == (pytest.approx(25 * per_degree, abs=2), pytest.approx(60 * per_degree, abs=2))
    assert np.allclose(part.pixels(rays)[0], [per_degree - 0.5, per_degree - 0.5], atol=1)


@pytest.mark.parametrize(
    ("degrees", "projection", "extent", "pitch", "message"),
    [
        (
            *(200, "planar", "panorama", 0),
            "the frames cover 261 degrees, and a plane holds up to 100; write render.projection: cylindrical",
        ),
        (
            *(200, "spherical", (140, 0, 150, 10), 0),
            "[140, 0, 150, 10] lies outside the panorama, which holds a from -131 to 131 and b from -21 to 21, in degrees",
        ),
        (
            *(200, "spherical", (0, -100, 500, 10), 0),
            "[0, -100, 500, 10] is in degrees on a spherical panorama: expected a0, b0, a1, b1 with a1 - a0 up to 360 and b0 "
            "and b1 from -90 (up) to 90 (down)",
        ),
        # The camera looks up, so that its frames pass over what is above the reference camera.
        (
            *(360, "cylindrical", "panorama", 40),
            "the frames reach 90 degrees up or down, and a cylindrical panorama holds up to 80; write render.projection: "
            "spherical",
        ),
        (
            *(250, "panini", "panorama", 0),
            "the frames reach 156 degrees aside, and a panini panorama holds up to 150; write render.projection: spherical",
        ),
    ],
    ids=["plane", "outside", "no box", "pole", "far aside"],
)
def test_view_that_cannot_be_shown_is_refused(
    degrees: float, projection: str, extent: Extent, pitch: float, message: str
) -> None:
    with pytest.raises(InputError) as caught:
        planned(degrees, projection, extent, pitch=pitch)
    assert str(caught.value) == message
