"""The verdict on poses: each test of the table, and what an estimator doubts."""

from dataclasses import replace

import numpy as np
import pytest

from photonpano import Reason
from photonpano_poses import PoseEstimate, ScenePoints
from photonpano_poses.run import judge_poses

N_FRAMES = 40
GOOD = PoseEstimate(
    np.eye(3),
    np.zeros(4),
    0.0,
    np.tile(np.eye(3, 4), (N_FRAMES, 1, 1)),
    np.ones(N_FRAMES, np.bool_),
    np.full(N_FRAMES, 0.002),
    np.full(N_FRAMES, 0.1),
    ScenePoints(np.zeros((0, 3)), np.zeros(0, np.float32)),
    residual_ratio=0.5,
)
REST = np.arange(N_FRAMES) < 15


def test_good_poses_are_trusted() -> None:
    verdict = judge_poses(GOOD)
    assert (verdict.status, verdict.reasons, verdict.residual_ratio) == ("trusted", (), 0.5)
    assert judge_poses(replace(GOOD, residual_ratio=None)).status == "trusted"


@pytest.mark.parametrize(
    ("wrong", "what", "figure"),
    [
        ({"residual_ratio": 1.5}, "the poses do not explain the photons", 1.5),
        ({"std_position": np.full(N_FRAMES, 0.01)}, "the expected error of the positions", 1),
        ({"std_rotation_deg": np.full(N_FRAMES, 6.0)}, "the expected error of the rotations", 6),
        ({"std_position": np.full(N_FRAMES, np.inf)}, "the expected errors are not known", 1),
        ({"located": REST}, "many frames have no pose", 25 / 40),
    ],
)
def test_each_test_finds_its_case(wrong: dict[str, object], what: str, figure: float) -> None:
    verdict = judge_poses(replace(GOOD, **wrong))
    [reason] = verdict.reasons
    assert verdict.status == "doubtful"
    assert reason.what.startswith(what)
    assert reason.figure == pytest.approx(figure)


def test_doubts_of_the_estimator_come_first() -> None:
    doubt = Reason("the depth of the scene may be reversed", 0.99, 0.9, "", "move farther")
    verdict = judge_poses(replace(GOOD, doubts=(doubt,), residual_ratio=2.0))
    assert (verdict.status, verdict.reasons[0], len(verdict.reasons)) == ("doubtful", doubt, 2)
