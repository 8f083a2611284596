from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.geometry import canvas_of, corners, from_parameters, transform_points, translation

SHAPE = (40, 60)
small = st.floats(-0.2, 0.2)
shift = st.floats(-300, 300)
perspective = st.floats(-1e-3, 1e-3)
homographies = st.builds(lambda *p: from_parameters(p), small, small, small, small, shift, shift, perspective, perspective)
motions = st.lists(homographies, min_size=1, max_size=4).map(np.stack)
scales = st.floats(0.05, 16)


def test_canvas_of_one_frame_is_the_frame() -> None:
    canvas = canvas_of(np.eye(3)[None], SHAPE, 1.0)
    assert canvas.shape == SHAPE
    np.testing.assert_array_equal(canvas.transform, np.eye(3))


def test_canvas_of_two_frames_spans_both() -> None:
    canvas = canvas_of(np.stack([translation(-7, 0), translation(5.5, 2)]), SHAPE, 1.0)
    assert (canvas.width, canvas.height) == (60 + 7 + 6, 40 + 2)
    np.testing.assert_array_equal(canvas.transform, translation(7, 0))


def test_canvas_at_twice_the_scale_has_twice_the_rows_and_columns() -> None:
    canvas = canvas_of(translation(-7, 0)[None], SHAPE, 2.0)
    assert canvas.shape == (80, 120)
    # The first reference pixel covers the first two pixels of the canvas.
    np.testing.assert_allclose(transform_points(canvas.transform, [[-7, 0]]), [[0.5, 0.5]])


@given(motions, scales)
def test_canvas_holds_every_corner_without_spare_rows(motion: np.ndarray, scale: float) -> None:
    canvas = canvas_of(motion, SHAPE, scale)
    placed = transform_points(canvas.transform @ motion, corners(SHAPE)).reshape(-1, 2)
    before = placed.min(axis=0) + 0.5
    after = np.array([canvas.width, canvas.height]) - 0.5 - placed.max(axis=0)
    assert before.min() >= -1e-4
    assert after.min() >= -1e-4
    # The canvas begins and ends with whole reference pixels, and ends with a whole pixel of its own.
    assert before.max() <= 1.5 * scale + 1e-4
    assert after.max() <= 1.5 * scale + 1 + 1e-4


def test_canvas_of_frame_at_the_horizon_raises() -> None:
    behind = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.02, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"^homography 1 of 2 sends part of its frame behind the reference plane$"):
        canvas_of(np.stack([np.eye(3), behind]), SHAPE, 1.0)
