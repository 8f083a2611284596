"""Tests of what is refused to renderers that render on planes only."""

from typing import cast

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.capture import seen_through
from photonpano.geometry import Camera, Canvas, FrameTrajectory, canvas_around, covered_by, rotation_matrices
from photonpano.pipeline.rendering import AttributedRenderer
from photonpano.protocols import Renderer
from photonpano.testing.captures import MemorySource

SHAPE = (40, 60)
CAMERA = Camera.of(50.0, SHAPE)
LENS = Camera.of(50.0, SHAPE, [-0.1, 0, 0, 0])
PLANE = Canvas(*SHAPE, np.eye(3))
SPHERE = canvas_around(covered_by(np.eye(3)[None], CAMERA, SHAPE), CAMERA, 1.0, "spherical")


@pytest.mark.parametrize(
    ("canvas", "camera", "degrees", "reason"),
    [
        (
            SPHERE,
            CAMERA,
            0,
            "renders on a plane only, and this panorama is spherical; write render.use: merge, or render.projection: planar",
        ),
        (PLANE, LENS, 0, "does not render through a lens that distorts; write render.use: merge"),
        (PLANE, CAMERA, 120, "does not leave out frames that reach behind the plane; write render.use: merge"),
    ],
    ids=["sphere", "lens", "behind"],
)
def test_renderer_on_planes_is_not_called_for_other_canvases(
    canvas: Canvas, camera: Camera, degrees: float, reason: str
) -> None:
    turn = FrameTrajectory(CAMERA.homographies(rotation_matrices([[0, 0, 0], [0, np.radians(degrees), 0]])))
    source = seen_through(MemorySource(np.zeros((2, *SHAPE), np.uint8)), camera)
    renderer = AttributedRenderer(cast("Renderer", None), "renderer 'flat' of a plugin", 40, any_canvas=False)
    with pytest.raises(InputError) as caught:
        renderer.render(source, turn, FrameSpan(0, 2), canvas, 0.25, lambda _: None)
    assert str(caught.value) == f"renderer 'flat' of a plugin {reason}"
