"""Two motions in one capture: where a large part of the frame is not explained, the other motion is named, and its distance."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import parse_spec, run, simulate
from photonpano.capture.writing import truth_path
from photonpano.evaluation import corner_errors, load_truth
from photonpano.motion.graph import Rival
from photonpano.pipeline.alternatives import of_models_px

SMALL, LARGE = ((96, 144), 600, 100), ((112, 160), 700, 105)  # frame shape, frames, length of the pan in px
MOVES_PX = (0.02, 0.006)


@pytest.fixture
def run_with(tmp_path: Path) -> Callable:
    """Return what runs a pan past a street behind objects, and the errors of its frames."""

    def of(objects: list[dict], size: tuple = SMALL, **sections: Any) -> tuple:
        shape, n_frames, length_px = size
        keys = {
            "scene": {"kind": "street", "seed": 1},
            "path": {"kind": "pan", "length_px": length_px},
            "frame_shape": shape,
            "n_frames": n_frames,
            "flux": 0.5,
            "objects": objects,
            "seed": 1,
        }
        cube = tmp_path / "capture.npy"
        simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": keys}}), cube)
        spec = {"version": 1, "source": {"use": "packed-npy", "with": {"path": str(cube)}}}
        result = run(parse_spec(spec | sections, output=tmp_path / "run"))
        with np.load(tmp_path / "run" / "trajectory.npz") as found:
            arrays = dict(found)
        truth = load_truth(truth_path(cube))
        errors = corner_errors(arrays["homographies"], truth.homographies, shape, arrays["located"])
        return result, errors.errors_px, arrays["std_px"]

    return of


def test_motion_of_a_thing_that_fills_half_of_the_frame_has_a_rival(run_with: Callable) -> None:
    thing = {"size": (0.7, 0.7), "at": (0.4, 0.45), "moves_px": MOVES_PX, "seed": 1}
    result, errors_px, std_px = run_with([thing], LARGE, levels=2)
    assert result.verdict is not None
    assert result.verdict.reasons[0].what == "parts of the frame follow another motion than the one that was found"
    assert [each["what"] for each in result.record["decisions"]].count("rival_motion") == 1
    assert (errors_px <= 3 * std_px).mean() > 0.9


@pytest.mark.parametrize(("deviance", "share"), [(0.0, 1 / 2), (2.0, 1 / (1 + np.e)), (30.0, 0.0)])
def test_distance_to_another_model_counts_by_its_likelihood(deviance: float, share: float) -> None:
    rivals = {"rotation": Rival(1.0, 50, 7.0), "rotation with a lens": Rival(1.0, 52, 7.0 + deviance, 0.4)}
    assert of_models_px(rivals) == pytest.approx(0.4 * np.sqrt(share), abs=1e-3)


def test_error_is_not_known_where_most_of_the_frame_stands_still(run_with: Callable) -> None:
    result, _, std_px = run_with([{"size": (0.95, 0.95), "seed": 1}], levels=1)
    assert result.verdict.reasons[0].what == "more than half of the frame stands still while the rest moves"
    assert np.isinf(std_px).all()
    assert result.record["motion"] is None
